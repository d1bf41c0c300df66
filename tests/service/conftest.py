"""What all tests of the service share: a check for threads, a site, and one server for each module."""

import threading
import time

import pytest
from service.lines import SITE, Answers, site_in

ON_EARTH = SITE.replace("[stations]", '[frame]\nkind = "enu"\norigin = { lat_deg = 47.5, lon_deg = 8.0 }\n\n[stations]')

# Seconds that a thread of an ended stream may need: a running proof and a broker that does not answer end late.
PATIENCE = 8.0


@pytest.fixture(scope="module", autouse=True)
def no_thread_survives():
    """Fail the module if a thread of the service is alive after it: each stream must end all its threads."""
    before = set(threading.enumerate())
    yield
    until = time.monotonic() + PATIENCE
    for thread in threading.enumerate():
        if thread.name.startswith("optloc ") and thread not in before:
            thread.join(max(until - time.monotonic(), 0.0))
            assert not thread.is_alive(), f"the thread {thread.name!r} survives its stream"


@pytest.fixture(scope="session")
def on_earth(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("earth"), ON_EARTH)


@pytest.fixture(scope="module")
def server(on_earth):
    """Return a stream that listens, and its port."""
    pytest.importorskip("starlette")
    pytest.importorskip("uvicorn")
    from optloc.service.serve import serve
    from optloc.service.stream import Settings, Stream

    with Stream(on_earth, Settings(wait=0.05), Answers()) as stream:
        port, _ = serve(stream, port=0)
        yield stream, port
