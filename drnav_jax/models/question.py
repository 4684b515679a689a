"""What a vision-language model is asked about a frame, and how its answer is read (host code).

The words mean what the labels mean (`worlds.openings`, eq. 1). An answer is one JSON object; with a confidence c in a word,

    (1)  p(open) = max(c, 0.51) for "open", 1 - max(c, 0.51) for "blocked"

so that the word decides, however unsure it is; c = 1 where none is given. The same holds for p(dead end).
"""

import base64
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

PROMPT = """\
A small wheeled robot, a disc 0.5 m wide, stands in a corridor, a room or a yard. Below is what its cameras see at this \
moment, one picture for each way it could take: front, left and right of where it is heading.

A way is "open" if, setting out that way, the robot can drive until it is at least 2.5 m away, without going more than \
5 m and without ending in a dead end. Otherwise it is "blocked". Walls, furniture, cars, hedges and bushes, drops and \
panes of glass stop the robot; grass, marks on the ground, open doors and gaps at least 0.6 m wide do not.
The robot is in a dead end if none of the three ways is open, so that it would have to turn back.

Answer with one JSON object and nothing else:
{"front": "open|blocked", "left": "open|blocked", "right": "open|blocked", "dead_end": true|false, \
"confidence": {"front": c, "left": c, "right": c, "dead_end": c}}
Leave out a way of which there is no picture. Each c is the probability, from 0.5 to 1, that the word is right; \
"confidence" may be left out."""

_LEAST = 0.51
_LONGEST = 20_000  # characters of an answer that are read, from its end
_OPEN = {"open": True, "blocked": False}


class Reading(NamedTuple):
    """What an answer says."""

    path: dict[str, float]  # p(open) of the ways that were asked about
    dead_end: float  # p(dead end)


def picture(image: UInt8[np.ndarray, "h w 3"], max_side: int) -> str:
    """A data URL with the image as PNG, made smaller where a side is longer than `max_side` pixels."""
    drawn = Image.fromarray(image)
    scale = max_side / max(drawn.size)
    if scale < 1:
        w, h = (max(1, round(side * scale)) for side in drawn.size)
        drawn = drawn.resize((w, h), Image.Resampling.LANCZOS)
    held = io.BytesIO()
    drawn.save(held, "PNG")
    return "data:image/png;base64," + base64.b64encode(held.getvalue()).decode("ascii")


def content(images: Mapping[str, UInt8[np.ndarray, "_h _w 3"]], max_side: int) -> list[dict[str, Any]]:
    """The parts of the user's message: the prompt, then each way's name and picture.

    Args:
        images: By way.
        max_side: Of a picture [pixels].
    """
    parts: list[dict[str, Any]] = [{"type": "text", "text": PROMPT}]
    for way, image in images.items():
        parts.append({"type": "text", "text": f"{way}:"})
        parts.append({"type": "image_url", "image_url": {"url": picture(image, max_side)}})
    return parts


def complaint(reason: str) -> dict[str, Any]:
    """A part to add when an answer could not be read: at temperature 0 the same question gets the same answer."""
    return {"type": "text", "text": f"Your last answer could not be read: {reason}. Answer with that JSON object only."}


def read(text: str, ways: Sequence[str]) -> Reading:
    """What an answer says. Text or code fences around the object do not matter; of several objects the last counts.

    Args:
        text: The answer.
        ways: Those that were asked about; others are ignored.

    Raises:
        ValueError: If it is not what the prompt demands; says why, without quoting it.
    """
    said = _last_object(text[-_LONGEST:])
    sure = said.get("confidence")
    path = {}
    for way in ways:
        word = said.get(way)
        word = word.strip().lower() if isinstance(word, str) else word
        if not isinstance(word, str) or word not in _OPEN:
            raise ValueError(f'"{way}" must be "open" or "blocked"')
        path[way] = _probability(_OPEN[word], sure, way)
    flag = said.get("dead_end")
    if not isinstance(flag, bool):
        raise ValueError('"dead_end" must be true or false')
    return Reading(path, _probability(flag, sure, "dead_end"))


def _probability(said: bool, confidence: Any, name: str) -> float:
    """Eq. 1; the confidence is one number for all words, or an object with some of them."""
    c = confidence.get(name) if isinstance(confidence, dict) else confidence
    if c is None:
        c = 1.0
    if isinstance(c, bool) or not isinstance(c, int | float) or not 0 <= c <= 1:  # NaN is neither
        raise ValueError('"confidence" must hold numbers from 0.5 to 1')
    c = max(float(c), _LEAST)
    return c if said else 1.0 - c


def _last_object(text: str) -> dict[str, Any]:
    """The last outermost JSON object in a text."""
    decode, found, at = json.JSONDecoder().raw_decode, None, text.find("{")
    while at >= 0:
        try:
            value, end = decode(text, at)
        except (ValueError, RecursionError):
            end = at + 1
        else:
            found = value
        at = text.find("{", end)
    if found is None:
        raise ValueError("it holds no JSON object")
    return found
