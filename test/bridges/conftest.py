"""Every module here has a middleware domain, a listener and the foreign packages that it names as PACKAGES."""

import pytest

from test.interfaces import used
from test.ros.processes import Listener, own_domain


@pytest.fixture(scope="module", autouse=True)
def domain(request):
    with used(*request.module.PACKAGES), own_domain() as number:
        yield number


@pytest.fixture
def listener(domain):
    listener = Listener()
    yield listener
    listener.close()
