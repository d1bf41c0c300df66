"""The configuration of nginx on the page of the reverse proxy: passwords, encryption, clients and the websocket."""

import base64
import http.client
import json
import re
import shutil
import socket
import ssl
import subprocess
import time
from pathlib import Path

import pytest
from service.lines import Answers, arrivals, differences, line

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
connect = pytest.importorskip("websockets.sync.client").connect

from optloc.service.http_options import access_of  # noqa: E402
from optloc.service.serve import serve  # noqa: E402
from optloc.service.stream import Settings, Stream  # noqa: E402

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "reverse-proxy.md"
NGINX = shutil.which("nginx", path="/usr/sbin:/usr/local/sbin:/usr/bin")
HOST, TOKEN = "fixes.example.org", "a-token-of-the-proxy"


def configuration(folder, port, behind):
    """Return the configuration of the page with other files and ports, as a whole file for nginx."""
    text = re.search(r"```\{code-block\} nginx\n:caption: optloc.conf\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    for old, new in (
        ("listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
        ("127.0.0.1:8200", f"127.0.0.1:{behind}"),
        ("/etc/ssl/fixes", f"{folder}/fixes"),
        ("/etc/nginx/optloc.users", f"{folder}/users"),
        ("Bearer TOKEN", f"Bearer {TOKEN}"),
    ):
        assert text.count(old) in (1, 2), old
        text = text.replace(old, new)
    paths = "".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = "user root;" if Path("/").owner() == "root" == Path.home().owner() else ""
    http_block = f"http {{ {paths} access_log off; {text} }}"
    return f"{user} daemon off; pid {folder}/pid; error_log {folder}/errors; events {{}} {http_block}"


@pytest.fixture
def proxy(on_earth, tmp_path):
    """Return the port of nginx in front of a server, and a TLS context that knows its certificate."""
    if NGINX is None or shutil.which("openssl") is None:
        pytest.skip("needs nginx and openssl")
    (tmp_path / "tokens").write_text(f"{TOKEN}\n")
    stream = Stream(on_earth, Settings(), Answers())
    behind, stop = serve(stream, port=0, access=access_of([HOST], tmp_path / "tokens"))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    made = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -keyout fixes.key -out fixes.pem".split()
    made += ["-subj", f"/CN={HOST}", "-addext", f"subjectAltName=DNS:{HOST}"]
    subprocess.run(made, cwd=tmp_path, check=True, capture_output=True)
    users = []
    for name in ("anna", "ben"):
        hashed = subprocess.run(
            ["openssl", "passwd", "-apr1", f"of {name}"], check=True, capture_output=True, text=True
        )
        users.append(f"{name}:{hashed.stdout.strip()}\n")
    (tmp_path / "users").write_text("".join(users))
    (tmp_path / "nginx.conf").write_text(configuration(tmp_path, port, behind))
    running = subprocess.Popen([NGINX, "-p", str(tmp_path), "-c", "nginx.conf"], stderr=subprocess.PIPE)
    try:
        for _ in range(100):
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                assert running.poll() is None, running.stderr.read()
                time.sleep(0.05)
        yield port, ssl.create_default_context(cafile=tmp_path / "fixes.pem")
    finally:
        running.terminate()
        running.wait(10.0)
        stream.close()
        assert stream.ended.wait(10.0)
        stop()


def basic(name, password):
    return {"Authorization": "Basic " + base64.b64encode(f"{name}:{password}".encode()).decode()}


def test_the_proxy_of_the_page_serves_users_only(on_earth, proxy):
    port, context = proxy
    z = differences(on_earth, arrivals(on_earth, 2)).tolist()

    def ask(method, path, body=None, headers=None):
        connection = http.client.HTTPSConnection(HOST, timeout=20.0, context=context)
        # the name of the certificate, at the address of this machine
        connection.sock = context.wrap_socket(socket.create_connection(("127.0.0.1", port), 20.0), server_hostname=HOST)
        connection.request(method, path, body, {"Host": f"{HOST}:{port}"} | (headers or {}))
        answer = connection.getresponse()
        found = answer.status, answer.headers, answer.read()
        connection.close()
        return found

    assert ask("GET", "/health")[0] == 401
    assert ask("GET", "/health", headers=basic("anna", "of ben"))[0] == 401
    # a token of the server is no password of the proxy
    assert ask("GET", "/health", headers={"Authorization": f"Bearer {TOKEN}"})[0] == 401
    anna, ben = basic("anna", "of anna"), basic("ben", "of ben")
    code, headers, _ = ask("GET", "/health", headers=anna)
    assert (code, headers["strict-transport-security"], headers["x-content-type-options"]) == (
        200,
        "max-age=31536000",
        "nosniff",
    )
    # the same id of two users is two events
    for user, name, row in ((anna, "anna", z[0]), (ben, "ben", z[1])):
        code, _, body = ask("POST", "/fix", line(event="1", z=row), user | {"X-Client": "somebody else"})
        record = json.loads(body)
        assert (code, record["client"], record["status"]) == (200, name, "ok")
    assert ask("POST", "/fix", line(event="1", z=z[1]), anna)[0] == 409
    page = {"Origin": f"https://{HOST}:{port}"}
    assert ask("GET", "/map.json", headers=anna | page)[0] == 200
    assert ask("GET", "/map.json", headers=anna | {"Origin": "https://evil.example"})[0] == 403
    assert ask("POST", "/fix", b"x" * (2 << 20), anna)[0] == 413
    held, about = socket.create_connection(("127.0.0.1", port), 20.0), anna | page
    with connect(f"wss://{HOST}:{port}/ws", sock=held, ssl=context, additional_headers=about) as websocket:
        websocket.send(line(event="2", z=z[0]).decode())
        assert json.loads(websocket.recv(timeout=20.0))["client"] == "anna"
