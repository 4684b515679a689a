"""A vision-language model as judge of single frames: the rows GPT and Gemini of the paper's Table I (host code).

Any endpoint that speaks OpenAI's chat completions will do: a commercial one with its key, or a server on this machine
without. What is asked, and how answers are read, is in `question`; each way is shown by the camera that looks there
(`views`, eq. 1), and a way without a camera stays unknown.

What fails is tried again: time-outs, broken connections, busy and failing servers (408, 409, 425, 429, 5xx), answers that
cannot be read. The k-th wait is

    (1)  max(min(backoff 2^(k-1), longest_wait), what Retry-After asks for)

A server that asks for more than `longest_wait` is not waited for. A frame without an answer is NaN and says why; it never
raises. Where an endpoint turns down the key, the address or the model (401, 403, 404, 405, a redirect), the frames that
are left are not sent.

The key is read from the environment. It travels in one header to the host of `base_url`, only encrypted or within this
machine; redirects are not followed, and what a server says is quoted without it.
"""

import dataclasses
import datetime
import email.utils
import http.client
import ipaddress
import json
import math
import os
import re
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Shaped

from drnav_jax.models import question, views
from drnav_jax.types import CameraRig

_BUSY = (408, 409, 425, 429)
_TURNED_DOWN = (401, 403, 404, 405)
_MOST_BYTES = 4 << 20  # of a response
_QUOTED = 200  # characters of what a server says about an error


@dataclasses.dataclass(frozen=True)
class VlmSpec:
    """An endpoint, a model, and how patiently they are asked.

    Attributes:
        base_url: What comes before `/chat/completions`. Gemini:
            "https://generativelanguage.googleapis.com/v1beta/openai"; a server on this machine: "http://localhost:8000/v1".
        model: Name of a model that reads images.
        key_variable: Environment variable that holds the key; "" = none is needed.
        timeout: Longest wait for a response [s].
        retries: Further tries after the first.
        backoff: Wait after the first failure [s].
        longest_wait: Longest wait between two tries [s].
        concurrency: Most requests at a time.
        max_side: Images with a longer side are made smaller [pixels].
        temperature: Of sampling; None = not sent, for models that refuse it.
        seed: Of sampling; None = not sent, for endpoints that refuse it.
    """

    base_url: str = "https://api.openai.com/v1"
    model: str = "gpt-4o"
    key_variable: str = "OPENAI_API_KEY"
    timeout: float = 60.0
    retries: int = 4
    backoff: float = 1.0
    longest_wait: float = 60.0
    concurrency: int = 4
    max_side: int = 512
    temperature: float | None = 0.0
    seed: int | None = 0

    def __post_init__(self) -> None:
        """Check the address and ranges. No message quotes what may hold a key."""
        parts = urllib.parse.urlsplit(self.base_url)
        if "@" in parts.netloc or parts.query or parts.fragment:
            raise ValueError("base_url must hold no user, password, query or fragment: the key belongs in the environment.")
        try:
            known = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:  # of the port
            known = False
        if not known or not re.fullmatch(r"[!-~]+", self.base_url):
            raise ValueError(f'base_url must look like "https://HOST/v1", got {self.base_url!r}.')
        if not self.model:
            raise ValueError("model must name a model of the endpoint.")
        if self.key_variable and not re.fullmatch(r"[A-Z_][A-Z0-9_]*", self.key_variable):
            raise ValueError(
                "key_variable must be the NAME of an environment variable, in capitals, and not a key. If that was one, it"
                " may now be in your shell's history: have it replaced."
            )
        if self.key_variable and parts.scheme == "http" and not _is_here(parts.hostname or ""):
            raise ValueError(
                f"{self.base_url} is not encrypted, so no key may travel there: use https, or key_variable='' for a server"
                " that needs none."
            )
        for name in ("timeout", "backoff", "longest_wait"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be > 0 s and finite, got {getattr(self, name)}.")
        for name, least in (("retries", 0), ("concurrency", 1), ("max_side", 8)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be >= {least}, got {getattr(self, name)}.")
        if self.temperature is not None and not 0 <= self.temperature <= 2:
            raise ValueError(f"temperature must lie in 0..2, got {self.temperature}.")


class Answer(NamedTuple):
    """What a model says of one frame; of B frames, with a leading axis. The first two fields are a `views.Judgement`."""

    path: Any  # [3] float32, probability that the way to the front, left, right is open; NaN = unknown
    dead_end: Any  # [] float32, probability that none is; NaN = no answer
    seconds: Any  # [] float32, the request that was answered took so long [s]; NaN = no answer
    problem: Any  # str, why there is no answer, or ""; of B frames a tuple


@dataclasses.dataclass(frozen=True)
class _Line:
    """What the requests of one call share; its repr holds no key."""

    url: str
    opener: urllib.request.OpenerDirector
    key: str = dataclasses.field(repr=False)
    halt: threading.Event = dataclasses.field(default_factory=threading.Event)  # set: send nothing any more,
    reasons: list[str] = dataclasses.field(default_factory=list)  # for the first of these


class _Response(NamedTuple):
    """What one request came to."""

    text: str = ""  # what the model says
    problem: str = ""  # or why it says nothing
    again: bool = True  # another try may help
    stop: bool = False  # every other frame would get the same
    wait: float = 0.0  # before another try, the server asks for this [s]


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """A redirect is an error like any other: the header with the key must not go elsewhere."""

    def redirect_request(self, *args: Any) -> None:
        """None: do not follow."""


def ask(
    spec: VlmSpec, images: Shaped[np.ndarray, "n h w 3"], rig: CameraRig, valid: Bool[np.ndarray, " n"] | None = None
) -> Answer:
    """Ask about one frame.

    Args:
        spec: Whom, and how.
        images: RGB, uint8.
        rig: Where the N cameras look.
        valid: Which images are there; None = all.

    Raises:
        ValueError: If the key is missing or malformed, or the images do not fit the rig.
    """
    many = ask_all(spec, images[None], rig, None if valid is None else valid[None])
    return Answer(many.path[0], many.dead_end[0], many.seconds[0], many.problem[0])


def ask_all(
    spec: VlmSpec, images: Shaped[np.ndarray, "b n h w 3"], rig: CameraRig, valid: Bool[np.ndarray, "b n"] | None = None
) -> Answer:
    """Ask about B frames, `spec.concurrency` at a time.

    Args:
        spec: Whom, and how.
        images: RGB, uint8.
        rig: Fields `[B, N, ...]`, or `[N, ...]` for all frames.
        valid: Which images are there; None = all.

    Raises:
        ValueError: If the key is missing or malformed, or the images do not fit the rig.
    """
    line, cameras = _line(spec), views.shown(images, rig, valid)
    with ThreadPoolExecutor(max_workers=spec.concurrency) as pool:
        waiting = [pool.submit(_ask, spec, line, frame, which) for frame, which in zip(images, cameras, strict=True)]
        try:
            answers = [each.result() for each in waiting]
        except BaseException:  # Ctrl-C: those on their way end, the others do not begin
            line.halt.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return Answer(
        path=np.array([a.path for a in answers], np.float32).reshape(-1, 3),
        dead_end=np.array([a.dead_end for a in answers], np.float32),
        seconds=np.array([a.seconds for a in answers], np.float32),
        problem=tuple(a.problem for a in answers),
    )


def _ask(spec: VlmSpec, line: _Line, images: np.ndarray, cameras: np.ndarray) -> Answer:
    """One frame, with all its tries."""
    seen = {way: images[k] for way, k in zip(views.WAYS, cameras, strict=True) if k != views.NO_CAMERA}
    if not seen:
        return _silence("no camera shows a way")
    parts, problem = question.content(seen, spec.max_side), ""
    asked: dict[str, Any] = {"model": spec.model, "messages": [{"role": "user", "content": parts}]}
    asked |= {k: v for k in ("temperature", "seed") if (v := getattr(spec, k)) is not None}
    for k in range(spec.retries + 1):
        if line.halt.is_set():
            return _silence(f"given up: {line.reasons[0] if line.reasons else 'interrupted'}")
        began = time.monotonic()
        got = _send(spec, line, asked)
        seconds = time.monotonic() - began
        problem, wait = got.problem, max(min(spec.backoff * 2.0 ** min(k, 60), spec.longest_wait), got.wait)
        if not problem:
            try:
                reading = question.read(got.text, tuple(seen))
            except ValueError as error:
                problem, wait = f"the answer cannot be read: {error}", 0.0  # the server is well
                asked["messages"] = [{"role": "user", "content": [*parts, question.complaint(str(error))]}]
            else:
                path = np.array([reading.path.get(way, math.nan) for way in views.WAYS], np.float32)
                return Answer(path, np.float32(reading.dead_end), np.float32(seconds), "")
        if got.stop:
            line.reasons.append(problem)
            line.halt.set()
        if not got.again or k == spec.retries:
            break
        if wait > spec.longest_wait:
            return _silence(f"{problem}; it asks for a wait of {wait:.0f} s, longest_wait is {spec.longest_wait:g} s")
        line.halt.wait(wait)
    return _silence(problem)


def _silence(problem: str) -> Answer:
    return Answer(np.full(3, np.nan, np.float32), np.float32(np.nan), np.float32(np.nan), problem)


def _is_here(host: str) -> bool:
    """Whether a host is this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _line(spec: VlmSpec) -> _Line:
    """The key, and an opener that follows no redirects, logs nothing and leaves unencrypted traffic to no proxy."""
    key = os.environ.get(spec.key_variable, "").strip() if spec.key_variable else ""
    if spec.key_variable and not key:
        raise ValueError(f"set {spec.key_variable} to the key of {spec.base_url}, or key_variable='' where none is needed.")
    if not re.fullmatch(r"[!-~]*", key):
        raise ValueError(f"{spec.key_variable} holds characters that no key has, spaces or line breaks: copy it again.")
    proxies = {k: v for k, v in urllib.request.getproxies().items() if k == "https"}
    opener = urllib.request.build_opener(
        _NoRedirects(), urllib.request.ProxyHandler(proxies),
        urllib.request.HTTPHandler(debuglevel=0), urllib.request.HTTPSHandler(debuglevel=0),
    )  # fmt: skip
    return _Line(url=spec.base_url.rstrip("/") + "/chat/completions", opener=opener, key=key)


def _send(spec: VlmSpec, line: _Line, asked: dict[str, Any]) -> _Response:
    """One request."""
    headers = {"Content-Type": "application/json", "Accept": "application/json", "User-Agent": "drnav_jax"}
    if line.key:
        headers["Authorization"] = f"Bearer {line.key}"
    request = urllib.request.Request(line.url, data=json.dumps(asked).encode(), headers=headers, method="POST")
    deadline = time.monotonic() + spec.timeout
    late = _Response(problem=f"no response within {spec.timeout:g} s")
    try:
        with line.opener.open(request, timeout=spec.timeout) as response:
            body = bytearray()
            # read1, since a read waits anew for every packet: a server that drips would hold the line
            while piece := response.read1(1 << 16):
                body += piece
                if time.monotonic() > deadline:
                    return late
                if len(body) > _MOST_BYTES:
                    return _Response(problem=f"a response of more than {_MOST_BYTES} bytes")
            if response.length:  # still to come, says Content-Length
                return _Response(problem="the response broke off")
    except urllib.error.HTTPError as error:
        with error:
            return _refusal(error, line.key)
    except (OSError, ValueError, http.client.HTTPException) as error:  # URLError is an OSError; a host name may be no name
        reason = getattr(error, "reason", error)
        if isinstance(reason, TimeoutError):
            return late
        return _Response(problem=f"no connection: {_quoted(f'{type(reason).__name__} {reason}', line.key)}")
    try:
        text = json.loads(body)["choices"][0]["message"]["content"]
    except (ValueError, LookupError, TypeError, RecursionError):
        text = None
    if isinstance(text, list):  # some servers give the parts of a message
        text = "".join(p["text"] for p in text if isinstance(p, dict) and isinstance(p.get("text"), str))
    if not isinstance(text, str):
        return _Response(problem="the response holds no message")
    return _Response(text=text)


def _refusal(error: urllib.error.HTTPError, key: str) -> _Response:
    """What an error status means."""
    status = error.code
    if 300 <= status < 400:
        return _Response(problem=f"HTTP {status}, a redirect: set base_url to the final address", again=False, stop=True)
    try:
        said = json.loads(error.read(1 << 16))["error"]["message"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError, http.client.HTTPException):
        said = ""
    # a server that turns down a key may quote parts of it
    tail = f": {_quoted(said, key)}" if isinstance(said, str) and said and status not in (401, 403) else ""
    again = status in _BUSY or status >= 500
    return _Response(
        problem=f"HTTP {status}{tail}", again=again, stop=status in _TURNED_DOWN, wait=_retry_after(error) if again else 0.0
    )


def _retry_after(error: urllib.error.HTTPError) -> float:
    """Seconds that a Retry-After header asks to wait: it holds a number or a date."""
    value = error.headers.get("Retry-After", "").strip()
    try:
        seconds = float(value)
    except ValueError:
        try:
            date = email.utils.parsedate_to_datetime(value)
        except ValueError:
            return 0.0
        date = date if date.tzinfo else date.replace(tzinfo=datetime.UTC)
        seconds = (date - datetime.datetime.now(datetime.UTC)).total_seconds()
    return max(seconds, 0.0) if not math.isnan(seconds) else 0.0


def _quoted(said: str, key: str) -> str:
    """What a server says, on one line, short, without the key."""
    said = " ".join((said.replace(key, "[key]") if key else said).split())
    return said if len(said) <= _QUOTED else said[:_QUOTED] + "..."
