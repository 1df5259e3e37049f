"""The server of the live view answers its own page alone."""

import asyncio
import re
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import pytest
from live_view import PATIENCE

aiohttp = pytest.importorskip("aiohttp", reason="trame: install autdtorch[explore]")
msgpack = pytest.importorskip("msgpack", reason="trame: install autdtorch[explore]")
from wslink.chunking import UnChunker, generate_chunks  # noqa: E402


@pytest.fixture
def explorer(shared):
    return shared[0]


def status(address, **headers):
    """HTTP status of a request, and what it answers."""
    try:
        with urllib.request.urlopen(
            urllib.request.Request(address, headers=headers), timeout=PATIENCE
        ) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def in_thread(coroutine):
    """Run a coroutine: in this thread, Playwright may have a loop."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, asyncio.wait_for(coroutine, PATIENCE)).result()


def socket_status(explorer, path, origin):
    """HTTP status of the handshake of a WebSocket; 101 if it is accepted."""
    address = f"ws://{urlsplit(explorer.address).netloc}/{path}"

    async def shake():
        async with aiohttp.ClientSession() as session:
            try:
                async with session.ws_connect(address, headers={"Origin": origin}):
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    return in_thread(shake())


def parts(explorer):
    """Scheme with host and port, and the token, of the address."""
    url = urlsplit(explorer.address)
    return f"http://{url.netloc}", url.path.split("/")[1]


async def call(connection, method, *arguments):
    """Call the server as a page does; return the answer."""
    name = f"{'system' if method == 'wslink.hello' else 'rpc'}:{method}"
    chunks = generate_chunks(msgpack.packb({"id": name, "method": method, "args": arguments}), 0)
    await connection.send_bytes(next(chunks))
    parts = UnChunker()
    parts.set_max_message_size(2**30)
    while True:
        message = parts.process_chunk((await connection.receive()).data)
        if message and message["id"] == name:
            return message.get("result")


def test_a_page_that_does_not_read_delays_no_other(explorer):
    host, token = parts(explorer)
    address, secret = f"{host.replace('http', 'ws')}/{token}/ws", {"secret": "wslink-secret"}
    connect = {"headers": {"Origin": host}, "max_msg_size": 0}

    async def open_two():
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(address, **connect) as stalled,
            session.ws_connect(address, **connect) as page,
        ):
            await call(stalled, "wslink.hello", secret)  # and reads no more
            await call(page, "wslink.hello", secret)
            for letter in "abcd":  # more than the buffers of the connection hold
                value = (letter + "+-") * 1_000_000
                await call(page, "trame.state.update", [{"key": "folder", "value": value}])
            answer = await call(page, "trame.state.get")
            return answer["state"]["folder"][0]

    assert in_thread(open_two()) == "d"


CLOSED_AT_WORK = """
import ctypes, gc, sys, threading, time
import autdtorch as at

scene = at.load_scene("configs/scene/sphere.yaml")
for _ in range(6):
    live = at.explore(scene, spacing=2.8e-3)
    time.sleep(0.05)
    assert any(one.name == "autdtorch explore" for one in threading.enumerate())
    live.close()
    assert not any(one.name.startswith("autdtorch explore") for one in threading.enumerate())
    del live
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    print(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1])
"""


@pytest.mark.usefixtures("shared")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_views_closed_while_they_calculate_keep_no_memory_and_print_nothing():
    ended = subprocess.run([sys.executable, "-c", CLOSED_AT_WORK], capture_output=True, text=True, check=True)
    memory = [int(line) / 1024 for line in re.findall(r"^\d+$", ended.stdout, re.MULTILINE)]
    # Flat once caches are full: each view varies by 15 MB, the less of two by less. A window that is left
    # keeps 67 MB, two of them 134.
    assert len(memory) == 6
    assert min(memory[4:]) - min(memory[2:4]) < 60, memory
    assert "Traceback" not in ended.stderr


def test_page_and_socket_need_the_token(explorer):
    host, token = parts(explorer)
    assert status(explorer.address)[0] == 200
    assert socket_status(explorer, f"{token}/ws", host) == 101
    assert len(token) >= 32
    for path in ("", "index.html", "ws", "__explore/explore.js", f"{token[:-1]}/index.html", "x/index.html"):
        code, text = status(f"{host}/{path}")
        assert code == 403
        assert token.encode() not in text
    for path in ("ws", "wrong/ws"):
        assert socket_status(explorer, path, host) == 403


def test_other_origins_and_other_names_of_this_machine_are_refused(explorer):
    """A page whose name was made to point here would be of one origin with the live view."""
    host, token = parts(explorer)
    port = urlsplit(explorer.address).port
    tunnel = "127.0.0.1:9000"  # of SSH, which may begin at another port
    for headers in (
        {"Origin": host},
        {"Host": f"localhost:{port}"},
        {"Host": tunnel, "Origin": f"http://{tunnel}"},
    ):
        assert status(explorer.address, **headers)[0] == 200
    for origin in ("http://example.org", "null", "http://127.0.0.1:1", "https://127.0.0.1.example.org"):
        assert status(explorer.address, Origin=origin)[0] == 403
    assert status(explorer.address, Host=f"example.org:{port}")[0] == 403
    assert socket_status(explorer, f"{token}/ws", "http://example.org") == 403


OUTSIDE = (
    *("../../../../etc/passwd", "..%2f..%2f..%2fetc/passwd", "%2e%2e/%2e%2e/etc/passwd"),
    *("__explore/../page.py", "__explore/%2e%2e/server.py", "__explore//etc/passwd"),
)


def test_files_outside_are_refused(explorer):
    host, token = parts(explorer)
    url = urlsplit(host)
    for path in OUTSIDE:
        with socket.create_connection((url.hostname, url.port), timeout=PATIENCE) as connection:
            request = f"GET /{token}/{path} HTTP/1.1\r\nHost: {url.netloc}\r\nConnection: close\r\n\r\n"
            connection.sendall(request.encode())  # as it is: clients would tidy the path
            answer = b"".join(iter(lambda connection=connection: connection.recv(65536), b""))
        assert answer.split()[1] in (b"403", b"404")
        assert b"root:" not in answer
        assert b"def " not in answer


def test_it_listens_on_the_local_interface_alone(explorer):
    port = urlsplit(explorer.address).port
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in others - {"127.0.0.1"}:
        with pytest.raises(OSError):  # noqa: PT011 - refused, or no route
            socket.create_connection((address, port), timeout=2)
