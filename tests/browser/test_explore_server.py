"""The server of the live view answers its own page alone."""

import asyncio
import gc
import re
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import weakref
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import pytest

import autdtorch as at
from autdtorch.plot.view3d import rendering_problem

aiohttp = pytest.importorskip("aiohttp", reason="trame: install autdtorch[explore]")
msgpack = pytest.importorskip("msgpack", reason="trame: install autdtorch[explore]")
pytest.importorskip("trame_rca", reason="trame: install autdtorch[explore]")
from wslink.chunking import UnChunker, generate_chunks  # noqa: E402


@pytest.fixture(scope="module")
def explorer():
    if problem := rendering_problem():
        pytest.skip(problem)
    scene = at.load_scene("configs/scene/sphere.yaml")
    live = at.explore(scene, spacing=2e-3)
    yield live
    live.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", urlsplit(live.address).port), timeout=5)


def status(address, **headers):
    """HTTP status of a request, and what it answers."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def socket_status(explorer, path, origin):
    """HTTP status of the handshake of a WebSocket; 101 if it is accepted."""
    port = urlsplit(explorer.address).port

    async def shake():
        headers = {} if origin is None else {"Origin": origin}
        async with aiohttp.ClientSession() as session:
            try:
                async with session.ws_connect(f"ws://127.0.0.1:{port}/{path}", headers=headers):
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    with ThreadPoolExecutor(1) as thread:  # in this one, Playwright may have a loop
        return thread.submit(asyncio.run, shake()).result()


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

    with ThreadPoolExecutor(1) as thread:  # in this one, Playwright may have a loop
        assert thread.submit(asyncio.run, asyncio.wait_for(open_two(), 20)).result() == "d"


CLOSED_AT_WORK = """
import ctypes, gc, sys, threading, time
import autdtorch as at

scene = at.load_scene("configs/scene/sphere.yaml")
for _ in range(16):
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


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_views_closed_while_they_calculate_keep_no_memory_and_print_nothing():
    if problem := rendering_problem():
        pytest.skip(problem)
    ended = subprocess.run([sys.executable, "-c", CLOSED_AT_WORK], capture_output=True, text=True, check=True)
    memory = [int(line) / 1024 for line in re.findall(r"^\d+$", ended.stdout, re.MULTILINE)]
    # Flat once caches are full: each view varies by 15 MB, the least of five by less. A window that is
    # left keeps 67 MB; 4 MB for each of the last five would be 20 MB.
    assert len(memory) == 16
    assert min(memory[11:]) - min(memory[6:11]) < 20, memory
    assert "Traceback" not in ended.stderr


def test_the_page_needs_the_token(explorer):
    host, token = parts(explorer)
    assert status(explorer.address)[0] == 200
    assert len(token) >= 32
    for path in ("", "index.html", "ws", "__explore/explore.js", f"{token[:-1]}/index.html", "x/index.html"):
        code, text = status(f"{host}/{path}")
        assert code == 403
        assert token.encode() not in text


def test_pages_of_other_origins_are_refused(explorer):
    host, _ = parts(explorer)
    assert status(explorer.address, Origin=host)[0] == 200
    for origin in ("http://example.org", "null", "http://127.0.0.1:1", "https://127.0.0.1.example.org"):
        assert status(explorer.address, Origin=origin)[0] == 403


def test_other_names_of_this_machine_are_refused(explorer):
    """A page whose name was made to point here would be of one origin with the live view."""
    port = urlsplit(explorer.address).port
    assert status(explorer.address, Host=f"localhost:{port}")[0] == 200
    assert status(explorer.address, Host=f"example.org:{port}")[0] == 403
    tunnel = "127.0.0.1:9000"  # of SSH, which may begin at another port
    assert status(explorer.address, Host=tunnel, Origin=f"http://{tunnel}")[0] == 200


def test_the_socket_needs_token_and_origin(explorer):
    host, token = parts(explorer)
    assert socket_status(explorer, f"{token}/ws", host) == 101
    assert socket_status(explorer, "ws", host) == 403
    assert socket_status(explorer, "wrong/ws", host) == 403
    assert socket_status(explorer, f"{token}/ws", "http://example.org") == 403


@pytest.mark.parametrize(
    "path",
    [
        "../../../../etc/passwd",
        "..%2f..%2f..%2fetc/passwd",
        "%2e%2e/%2e%2e/etc/passwd",
        "__explore/../page.py",
        "__explore/%2e%2e/server.py",
        "__explore//etc/passwd",
    ],
)
def test_files_outside_are_refused(explorer, path):
    host, token = parts(explorer)
    url = urlsplit(host)
    with socket.create_connection((url.hostname, url.port), timeout=10) as connection:  # as it is, no tidying
        request = f"GET /{token}/{path} HTTP/1.1\r\nHost: {url.netloc}\r\nConnection: close\r\n\r\n"
        connection.sendall(request.encode())
        answer = b""
        while more := connection.recv(65536):
            answer += more
    assert answer.split()[1] in (b"403", b"404")
    assert b"root:" not in answer
    assert b"def " not in answer


def test_a_live_view_that_nobody_has_any_more_ends():
    live = at.explore(at.load_scene("configs/scene/sphere.yaml"), spacing=2e-3)
    port, gone = urlsplit(live.address).port, weakref.ref(live)
    del live
    gc.collect()
    assert gone() is None
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=5)


def test_ctrl_c_in_a_wait_leaves_a_view_to_be_closed():
    """A calculation that runs on while Python ends aborts the program."""
    live = at.explore(at.load_scene("configs/scene/sphere.yaml"), spacing=2e-3)
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # ignored, if a script started the tests
    threading.Timer(0.5, signal.raise_signal, [signal.SIGINT]).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            live.wait()
    finally:
        signal.signal(signal.SIGINT, before)
    live.scene = live.scene  # the server answers
    live.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", urlsplit(live.address).port), timeout=5)


def test_views_may_be_opened_by_several_threads_at_once():
    scene = at.load_scene("configs/scene/sphere.yaml")
    with ThreadPoolExecutor(3) as threads:
        opened = [threads.submit(at.explore, scene, spacing=2.8e-3) for _ in range(3)]
    views = [each.result() for each in opened]
    assert len({view.address for view in views}) == 3
    for view in views:
        view.close()


def test_a_spacing_too_large_for_the_scene_is_refused():
    with pytest.raises(ValueError, match="spacing"):
        at.explore(at.load_scene("configs/scene/sphere.yaml"), spacing=6e-3)


def test_it_listens_on_the_local_interface_alone(explorer):
    port = urlsplit(explorer.address).port
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in others - {"127.0.0.1"}:
        with pytest.raises(OSError):  # noqa: PT011 - refused, or no route
            socket.create_connection((address, port), timeout=2)
