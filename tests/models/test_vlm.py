"""Asking a model over HTTP, against a real server on loopback that answers late, wrongly or not at all."""

import base64
import contextlib
import dataclasses
import datetime
import email.utils
import http.client
import http.server
import io
import json
import logging
import os
import signal
import threading
import time

import numpy as np
import pytest
from PIL import Image

from drnav_jax.models import question, vlm
from drnav_jax.models.vlm import VlmSpec
from drnav_jax.types import FRONT_LEFT_RIGHT, NO_CAMERAS, RigSpec, rig_of

KEY = "sk-Very-Secret-0123456789"
GOOD = json.dumps({"front": "open", "left": "blocked", "right": "open", "dead_end": False, "confidence": {"left": 0.8}})
RIG = rig_of(RigSpec())


def completion(text):
    return json.dumps({"choices": [{"message": {"role": "assistant", "content": text}}]}).encode()


class Reply:
    """What the server does with a request: `before` answering it may wait, or choose another reply."""

    def __init__(self, text=GOOD, status=200, headers=(), body=None, length=None, before=lambda asked: None, pause=0.0):
        self.status, self.headers, self.before, self.pause = status, dict(headers), before, pause
        self.body = completion(text) if body is None else body
        self.length = len(self.body) if length is None else length


class Endpoint(http.server.ThreadingHTTPServer):
    """Answers each request with the next reply, the last one again and again; keeps what it was sent, and when."""

    daemon_threads = True

    def __init__(self, *replies):
        self.replies, self.requests, self.times = list(replies), [], []
        self.lock, self.closing = threading.Lock(), threading.Event()
        self.now = self.most = 0
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}/v1"

    def handle_error(self, request, client_address):
        """A client that did not wait is part of the tests."""


class Handler(http.server.BaseHTTPRequestHandler):
    server: Endpoint

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        with self.server.lock:
            reply = self.server.replies.pop(0) if len(self.server.replies) > 1 else self.server.replies[0]
            self.server.requests.append((self.path, dict(self.headers), body))
            self.server.times.append(time.monotonic())
            self.server.now += 1
            self.server.most = max(self.server.most, self.server.now)
        reply = reply.before(body) or reply
        with self.server.lock:
            self.server.now -= 1
        self.send_response(reply.status)
        for name, value in reply.headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(reply.length))
        self.end_headers()
        size = 1 if reply.pause else 1 << 20
        for k in range(0, len(reply.body), size):
            self.wfile.write(reply.body[k : k + size])
            if reply.pause and self.server.closing.wait(reply.pause):
                break

    do_GET = do_POST

    def log_message(self, *args):
        pass


@pytest.fixture
def serve(monkeypatch):
    """Starts endpoints, and ends them."""
    monkeypatch.setenv("TEST_KEY", KEY)
    with contextlib.ExitStack() as stack:

        def start(*replies):
            server = stack.enter_context(Endpoint(*replies))
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            stack.callback(server.closing.set)
            return server

        yield start


def spec_of(server, **fields):
    """Quick where it waits on purpose, patient where a slow machine may need it."""
    quick = {"key_variable": "TEST_KEY", "timeout": 20.0, "retries": 2, "backoff": 0.01, "longest_wait": 5.0}
    return VlmSpec(base_url=server.url, model="seer-1", **(quick | fields))


def frame(seed=0, cameras=3):
    return np.random.default_rng(seed).integers(0, 256, (cameras, 6, 8, 3), dtype=np.uint8)


def check_good(answer):
    assert answer.problem == ""
    np.testing.assert_allclose(answer.path, [1, 0.2, 1], atol=1e-6)
    assert answer.dead_end == 0 and 0 < answer.seconds < 20
    assert answer.path.dtype == answer.dead_end.dtype == answer.seconds.dtype == np.float32


def check_silent(answer, problem):
    assert np.isnan(answer.path).all() and np.isnan(answer.dead_end) and np.isnan(answer.seconds)
    assert problem in answer.problem and KEY not in repr(answer)


def test_a_good_answer(serve):
    server = serve(Reply())
    images = frame()
    check_good(vlm.ask(spec_of(server), images, RIG))
    [(path, headers, body)] = server.requests
    assert path == "/v1/chat/completions" and headers["Authorization"] == f"Bearer {KEY}"
    assert {k: body[k] for k in ("model", "temperature", "seed")} == {"model": "seer-1", "temperature": 0, "seed": 0}
    [message] = body["messages"]
    assert message["role"] == "user" and message["content"][0]["text"] == question.PROMPT
    sent = [p["image_url"]["url"] for p in message["content"] if p["type"] == "image_url"]
    for url, image in zip(sent, images, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1])))), image)


def test_the_camera_that_looks_there_shows_a_way_and_without_one_it_is_unknown(serve):
    """Cameras: behind, right, front. The answer says something of the left as well, which nobody showed."""
    server = serve(Reply())
    rig = rig_of(RigSpec(mounts=(dataclasses.replace(FRONT_LEFT_RIGHT[0], yaw=np.pi), *FRONT_LEFT_RIGHT[2::-2])))
    images = frame()
    answer = vlm.ask(spec_of(server), images, rig)
    np.testing.assert_array_equal(answer.path, [1, np.nan, 1])
    assert answer.dead_end == 0 and answer.problem == ""
    parts = server.requests[0][2]["messages"][0]["content"][1:]
    assert parts == question.content({"front": images[2], "right": images[1]}, 512)[1:]
    only = vlm.ask(spec_of(server), images, rig, np.array([True, False, True]))
    np.testing.assert_array_equal(only.path, [1, np.nan, np.nan])


def test_without_any_camera_nothing_is_asked(serve):
    server = serve(Reply())
    check_silent(vlm.ask(spec_of(server), frame(cameras=0), rig_of(NO_CAMERAS)), "no camera shows a way")
    assert server.requests == []


def test_settings_that_an_endpoint_refuses_can_be_left_out_and_a_key_is_not_always_needed(serve, monkeypatch):
    monkeypatch.delenv("TEST_KEY")
    server = serve(Reply())
    check_good(vlm.ask(spec_of(server, temperature=None, seed=None, key_variable=""), frame(), RIG))
    _, headers, body = server.requests[0]
    assert set(body) == {"model", "messages"} and "Authorization" not in headers


def test_content_in_parts_is_put_together(serve):
    parts = [{"type": "text", "text": GOOD[:20]}, {"type": "image"}, {"type": "text", "text": GOOD[20:]}]
    check_good(vlm.ask(spec_of(serve(Reply(text=parts))), frame(), RIG))


def test_a_slow_answer_is_not_waited_for(serve):
    server = serve(Reply())
    server.replies[0].before = lambda asked: server.closing.wait(60) and None
    began = time.monotonic()
    check_silent(vlm.ask(spec_of(server, timeout=0.2), frame(), RIG), "no response within 0.2 s")
    assert len(server.requests) == 3 and time.monotonic() - began < 20


def test_nor_is_one_that_drips(serve):
    """Each byte comes within the time-out, all of them would take 100 s."""
    server = serve(Reply(body=b" " * 500, pause=0.2))
    began = time.monotonic()
    check_silent(vlm.ask(spec_of(server, timeout=1.0, retries=0), frame(), RIG), "no response within 1 s")
    assert time.monotonic() - began < 20


def test_a_slow_answer_then_a_good_one(serve):
    server = serve(Reply(), Reply())
    server.replies[0].before = lambda asked: server.closing.wait(60) and None
    check_good(vlm.ask(spec_of(server, timeout=2.0, retries=1), frame(), RIG))
    assert len(server.requests) == 2


@pytest.mark.parametrize("status", [408, 429, 500, 502, 503])
def test_a_failing_server_is_asked_again(serve, status):
    server = serve(Reply(status=status), Reply())
    check_good(vlm.ask(spec_of(server), frame(), RIG))
    assert len(server.requests) == 2
    assert server.requests[0][2] == server.requests[1][2]


def test_waits_double_up_to_the_longest(serve):
    server = serve(Reply(status=500))
    check_silent(vlm.ask(spec_of(server, retries=3, backoff=0.2, longest_wait=0.5), frame(), RIG), "HTTP 500")
    waits = np.diff(server.times)
    assert len(waits) == 3 and (waits >= [0.2, 0.4, 0.5]).all()


def test_retry_after_is_honoured(serve):
    server = serve(Reply(status=429, headers={"Retry-After": "1"}), Reply())
    check_good(vlm.ask(spec_of(server), frame(), RIG))
    assert np.diff(server.times)[0] >= 1.0


def test_retry_after_may_be_a_date_and_nonsense_counts_as_none():
    def wait(value):
        error = vlm.urllib.error.HTTPError("http://x", 429, "", http.client.HTTPMessage(), None)
        if value is not None:
            error.headers["Retry-After"] = value
        return vlm._retry_after(error)

    now = datetime.datetime.now(datetime.UTC)
    assert 25 < wait(email.utils.format_datetime(now + datetime.timedelta(seconds=30), usegmt=True)) <= 30
    assert wait(email.utils.format_datetime(now - datetime.timedelta(days=1), usegmt=True)) == 0
    assert [wait(v) for v in (None, "", "soon", "nan", "-3", "0.5", "7")] == [0, 0, 0, 0, 0, 0.5, 7]


def test_a_server_that_wants_a_longer_pause_is_left_alone(serve):
    server = serve(Reply(status=429, headers={"Retry-After": "40"}))
    check_silent(vlm.ask(spec_of(server), frame(), RIG), "HTTP 429; it asks for a wait of 40 s, longest_wait is 5 s")
    assert len(server.requests) == 1


def test_no_connection(serve):
    server = serve(Reply())
    spec = spec_of(server)
    server.shutdown()
    server.server_close()
    check_silent(vlm.ask(spec, frame(), RIG), "no connection: ConnectionRefusedError")


def test_a_host_that_cannot_be_looked_up_is_no_crash(serve):
    spec = dataclasses.replace(spec_of(serve(Reply())), base_url=f"https://{'x' * 70}.invalid/v1")  # too long for a name
    check_silent(vlm.ask(spec, frame(), RIG), "no connection: ")


def test_a_response_that_breaks_off_is_asked_for_again(serve):
    short = Reply()
    short.length += 10
    server = serve(short, Reply())
    check_good(vlm.ask(spec_of(server), frame(), RIG))
    check_silent(vlm.ask(spec_of(serve(short)), frame(), RIG), "broke off")


def test_an_endless_response_is_cut(serve):
    check_silent(vlm.ask(spec_of(serve(Reply(body=b" " * (5 << 20))), retries=0), frame(), RIG), "more than 4194304 bytes")


def test_an_unreadable_answer_is_asked_for_again_and_told_why(serve):
    server = serve(Reply("It looks open to me."), Reply(GOOD.replace("blocked", "narrow")), Reply())
    check_good(vlm.ask(spec_of(server, backoff=5.0), frame(), RIG))
    assert np.diff(server.times).max() < 5, "a server that is well needs no pause"
    first, second, third = (body["messages"][0]["content"] for _, _, body in server.requests)
    assert second[:-1] == third[:-1] == first
    assert "no JSON object" in second[-1]["text"] and '"left" must be' in third[-1]["text"]


@pytest.mark.parametrize(
    "body",
    [
        b"", b"<html>busy</html>", b"\xff\xfe", b"null", b"{}", b'{"choices": []}', completion(None), completion(3),
        b"[" * 100_000, completion("no idea"), completion(""),
    ],
)  # fmt: skip
def test_answers_that_are_never_readable_give_none(serve, body):
    server = serve(Reply(body=body))
    answer = vlm.ask(spec_of(server), frame(), RIG)
    check_silent(answer, "cannot be read" if body in (completion("no idea"), completion("")) else "holds no message")
    assert len(server.requests) == 3


def test_a_bad_request_is_not_repeated_and_says_why(serve):
    said = {"error": {"message": f"Unsupported value:\n 'seed' (key {KEY})" + "!" * 300}}
    server = serve(Reply(status=400, body=json.dumps(said).encode()))
    answers = vlm.ask_all(spec_of(server, concurrency=1), np.stack([frame()] * 2), RIG)
    assert len(server.requests) == 2, "it may be this one frame"
    want = "HTTP 400: Unsupported value: 'seed' (key [key])!!!"
    assert all(p.startswith(want) and p.endswith("!...") and len(p) < 230 for p in answers.problem)
    assert KEY not in repr(answers)


@pytest.mark.parametrize("status", [401, 403, 404])
def test_an_endpoint_that_turns_everything_down_is_not_asked_for_every_frame(serve, status):
    server = serve(Reply(status=status, body=json.dumps({"error": {"message": f"not with {KEY[:9]}..."}}).encode()))
    answers = vlm.ask_all(spec_of(server, concurrency=1), np.stack([frame()] * 4), RIG)
    assert len(server.requests) == 1
    first, *others = answers.problem
    assert first.startswith(f"HTTP {status}") and others == [f"given up: {first}"] * 3
    assert np.isnan(answers.path).all() and np.isnan(answers.dead_end).all()
    assert (KEY[:9] in first) == (status == 404), "who turns down a key may quote it"


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_a_redirect_does_not_carry_the_key_elsewhere(serve, status):
    other = serve(Reply())
    server = serve(Reply(status=status, headers={"Location": f"{other.url}/chat/completions"}))
    check_silent(vlm.ask(spec_of(server), frame(), RIG), f"HTTP {status}, a redirect: set base_url")
    assert len(server.requests) == 1 and other.requests == []


def test_a_proxy_does_not_get_what_is_not_encrypted(serve, monkeypatch):
    proxy, server = serve(Reply()), serve(Reply())
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{proxy.server_port}")
    check_good(vlm.ask(spec_of(server), frame(), RIG))
    assert proxy.requests == []


def test_the_key_is_in_no_log_and_no_exception(serve, monkeypatch, caplog, capfd):
    caplog.set_level(logging.DEBUG)
    monkeypatch.setattr(http.client.HTTPConnection, "debuglevel", 1)  # would print every header
    broken = Reply(status=200, body=b"x", length=5)
    wrong = Reply(status=500, body=json.dumps({"error": {"message": f"Bearer {KEY}"}}).encode())
    server = serve(Reply(status=429), broken, wrong, Reply("{}"), Reply())
    spec = spec_of(server, retries=4)
    check_good(vlm.ask(spec, frame(), RIG))
    assert len(server.requests) == 5 and all(h["Authorization"].endswith(KEY) for _, h, _ in server.requests)
    check_silent(vlm.ask(spec_of(serve(wrong)), frame(), RIG), "HTTP 500: Bearer [key]")
    monkeypatch.setenv("TEST_KEY", f"{KEY}\nX-Other: 1")
    with pytest.raises(ValueError, match="TEST_KEY holds characters that no key has") as refused:
        vlm.ask(spec, frame(), RIG)
    out, err = capfd.readouterr()
    texts = (out, err, caplog.text, repr(spec), repr(refused.value))
    assert not any(KEY in text for text in texts)


def test_what_the_requests_share_does_not_show_the_key(serve):
    line = vlm._line(spec_of(serve(Reply())))
    assert line.key == KEY and KEY not in repr(line) and KEY not in str(vars(line.opener))


def test_a_missing_key_is_said_at_once(serve, monkeypatch):
    server = serve(Reply())
    for value in ("", "  \n"):
        monkeypatch.setenv("TEST_KEY", value)
        with pytest.raises(ValueError, match="set TEST_KEY to the key of http://127.0.0.1"):
            vlm.ask(spec_of(server), frame(), RIG)
    monkeypatch.setenv("TEST_KEY", f"  {KEY}\n")  # as `$(cat file)` and editors leave it
    check_good(vlm.ask(spec_of(server), frame(), RIG))
    assert server.requests[0][1]["Authorization"] == f"Bearer {KEY}"


def test_many_frames_keep_their_order_and_their_number_at_a_time_is_bound(serve):
    """Three wait for each other on the server, so three must be under way; more than three never are."""
    together = threading.Barrier(3)
    server = serve(Reply())
    server.replies[0].before = lambda asked: together.wait(20) and None
    images = np.stack([frame(k) for k in range(9)])
    images[4] = 0
    valid = np.ones((9, 3), bool)
    valid[4, 1] = False
    answers = vlm.ask_all(spec_of(server, concurrency=3, retries=0), images, RIG, valid)
    assert answers.problem == ("",) * 9 and server.most == 3 and len(server.requests) == 9
    assert answers.path.shape == (9, 3) and answers.dead_end.shape == answers.seconds.shape == (9,)
    assert np.argwhere(np.isnan(answers.path)).tolist() == [[4, 1]]


def test_each_answer_belongs_to_its_frame(serve):
    """The server reads the picture of the front: a bright one is open, and a dark one takes longer."""
    server = serve(Reply())

    def look(asked):
        url = asked["messages"][0]["content"][2]["image_url"]["url"]
        bright = np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1])))).mean() > 127
        time.sleep(0.0 if bright else 0.2)
        return Reply(GOOD if bright else GOOD.replace('"front": "open"', '"front": "blocked"'))

    server.replies[0].before = look
    bright = np.array([False, True, True, False, True])
    images = np.broadcast_to(np.where(bright, 255, 0)[:, None, None, None, None], (5, 3, 4, 4, 3)).astype(np.uint8)
    np.testing.assert_array_equal(vlm.ask_all(spec_of(server, concurrency=5), images, RIG).path[:, 0], bright)


def test_no_frames(serve):
    none = vlm.ask_all(spec_of(serve(Reply())), np.zeros((0, 3, 4, 4, 3), np.uint8), RIG)
    assert none.path.shape == (0, 3) and none.dead_end.shape == (0,) and none.problem == ()


def test_ctrl_c_sends_nothing_more(serve, ctrl_c):
    server = serve(Reply(status=500))
    server.replies[0].before = lambda asked: os.kill(os.getpid(), signal.SIGINT)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        vlm.ask_all(spec_of(server, concurrency=1, backoff=60.0, longest_wait=60.0), np.stack([frame()] * 5), RIG)
    assert len(server.requests) == 1 and time.monotonic() - began < 40


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"base_url": "api.openai.com/v1"}, "must look like"),
        ({"base_url": "ftp://host/v1"}, "must look like"),
        ({"base_url": "https://"}, "must look like"),
        ({"base_url": "https://host:port/v1"}, "must look like"),
        ({"base_url": "https://ho st/v1"}, "must look like"),
        ({"base_url": f"https://me:{KEY}@host/v1"}, "no user, password"),
        ({"base_url": f"https://host/v1?key={KEY}"}, "no user, password, query"),
        ({"base_url": "http://host/v1"}, "not encrypted"),
        ({"base_url": "http://127.0.0.1.host.example/v1"}, "not encrypted"),
        ({"key_variable": KEY}, "NAME of an environment variable"),
        ({"key_variable": "AIzaSyVery0Secret"}, "NAME of an environment variable"),
        ({"model": ""}, "model must name"),
        ({"timeout": 0.0}, "timeout must be > 0 s"),
        ({"backoff": float("inf")}, "backoff must be > 0 s and finite"),
        ({"longest_wait": float("nan")}, "longest_wait must be"),
        ({"retries": -1}, "retries must be >= 0"),
        ({"concurrency": 0}, "concurrency must be >= 1"),
        ({"max_side": 4}, "max_side must be >= 8"),
        ({"temperature": 3.0}, "temperature must lie in 0..2"),
    ],
)
def test_specs_that_make_no_sense_are_refused(fields, match):
    with pytest.raises(ValueError, match=match) as refused:
        VlmSpec(**fields)
    assert KEY not in str(refused.value) and "AIza" not in str(refused.value)


@pytest.mark.parametrize("host", ["localhost:8000", "127.0.0.1", "127.8.1.2:1", "[::1]:8000"])
def test_this_machine_needs_no_encryption(host):
    assert VlmSpec(base_url=f"http://{host}/v1").base_url.endswith("/v1")
    assert VlmSpec(base_url="http://192.168.0.7/v1", key_variable="").key_variable == ""


def test_images_must_fit_and_be_integers(serve):
    server = serve(Reply())
    with pytest.raises(ValueError, match="uint8"):
        vlm.ask(spec_of(server), frame().astype(np.float32) / 255, RIG)
    with pytest.raises(ValueError, match="rig"):
        vlm.ask(spec_of(server), frame(cameras=2), RIG)
    assert server.requests == []
