"""Service calls to a node under test."""

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from std_srvs.srv import Trigger

from test.ros.processes import NODE


def parameter(name, value):
    kinds = {bool: ("bool", 1), int: ("integer", 2), float: ("double", 3), str: ("string", 4)}
    field, kind = kinds[type(value)]
    return Parameter(name=name, value=ParameterValue(**{"type": kind, f"{field}_value": value}))


def set_together(listener, **values):
    request = SetParametersAtomically.Request(parameters=[parameter(n, v) for n, v in values.items()])
    return listener.call(SetParametersAtomically, f"{NODE}/set_parameters_atomically", request).result


def number(listener, name):
    request = GetParameters.Request(names=[name])
    value = listener.call(GetParameters, f"{NODE}/get_parameters", request).values[0]
    return value.double_value if value.type == ParameterType.PARAMETER_DOUBLE else value.integer_value


def transition(listener, number):
    request = ChangeState.Request(transition=Transition(id=number))
    return listener.call(ChangeState, f"{NODE}/change_state", request).success


def state(listener):
    return listener.call(GetState, f"{NODE}/get_state", GetState.Request()).current_state.id


def trigger(listener, service):
    return listener.call(Trigger, f"{NODE}/{service}", Trigger.Request())
