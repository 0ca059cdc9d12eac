"""Every test here has a middleware domain and a listener of its own."""

import pytest

from test.ros.processes import Listener, own_domain


@pytest.fixture(scope="module", autouse=True)
def domain():
    with own_domain() as number:
        yield number


@pytest.fixture
def listener(domain):
    listener = Listener()
    yield listener
    listener.close()
