"""The site and the server that tests of requests share: one server for each module."""

import pytest
from service.lines import SITE, Answers, site_in

ON_EARTH = SITE.replace("[stations]", '[frame]\nkind = "enu"\norigin = { lat_deg = 47.5, lon_deg = 8.0 }\n\n[stations]')


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

    stream = Stream(on_earth, Settings(wait=0.05), Answers())
    port, stop = serve(stream, port=0)
    yield stream, port
    stream.close()
    assert stream.ended.wait(10.0)
    stop()
