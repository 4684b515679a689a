"""The symbols of a film, drawn with Pillow: positions and sizes in pixels, y down.

Everything is drawn at `FINE` times its size and halved later; sizes here count pixels of the finished picture.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from drnav_jax.viz import look

FINE = 2
ROBOT, LOCAL_GOAL, INK, UNSEEN_WALL = "#5b21b6", "#e6007e", "#1f2329", "#c2c6cd"
LEGEND_HEIGHT, MARGIN = 34, 12

Length = float | int
Pixel = tuple[Length, Length]


def font(size: Length) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font: the same everywhere."""
    return ImageFont.load_default(size)


def _outline(xy: Pixel, arms: np.ndarray, angles: np.ndarray) -> list[Pixel]:
    """Corners around a point; angles count from +x, clockwise as y is down."""
    corners = np.asarray(xy) + arms[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return [(x, y) for x, y in corners.tolist()]


def dot(draw: ImageDraw.ImageDraw, xy: Pixel, radius: Length, colour: str) -> None:
    """A disc with a white rim."""
    for r, fill in ((radius + 1.0, "white"), (radius, colour)):
        r *= FINE
        draw.ellipse((xy[0] - r, xy[1] - r, xy[0] + r, xy[1] + r), fill=fill)


def robot(draw: ImageDraw.ImageDraw, xy: Pixel, yaw: Length, radius: Length) -> None:
    """A disc with a white arrow that points ahead."""
    dot(draw, xy, radius, ROBOT)
    arms = FINE * radius * np.asarray([0.85, 0.8, 0.25, 0.8])
    draw.polygon(_outline(xy, arms, np.asarray([0.0, 2.5, np.pi, -2.5]) - yaw), fill="white")


def star(draw: ImageDraw.ImageDraw, xy: Pixel, radius: Length) -> None:
    """The goal."""
    angles, arms = np.pi * (np.arange(10) / 5 - 0.5), np.where(np.arange(10) % 2, 0.42, 1.0)
    for r, fill in ((1.3 * radius, INK), (radius, look.GOAL)):
        draw.polygon(_outline(xy, FINE * r * arms, angles), fill=fill)


def diamond(draw: ImageDraw.ImageDraw, xy: Pixel, radius: Length) -> None:
    """The local goal g*."""
    for r, fill in ((radius + 1.5, "white"), (radius, LOCAL_GOAL)):
        draw.polygon(_outline(xy, np.full(4, FINE * r), np.arange(4) * np.pi / 2), fill=fill)


def circle(draw: ImageDraw.ImageDraw, xy: Pixel, radius: Length) -> None:
    """The goal's tolerance."""
    r = FINE * radius
    draw.ellipse((xy[0] - r, xy[1] - r, xy[0] + r, xy[1] + r), outline=INK, width=FINE)


def path(draw: ImageDraw.ImageDraw, corners: list[Pixel]) -> None:
    """What was driven; steps of less than half a pixel are left out."""
    kept = corners[:1]
    for xy in corners[1:]:
        if abs(xy[0] - kept[-1][0]) + abs(xy[1] - kept[-1][1]) > 0.5 * FINE:
            kept.append(xy)
    if len(kept) > 1:
        draw.line(kept, fill="white", width=5 * FINE, joint="curve")
        draw.line(kept, fill=ROBOT, width=5 * FINE // 2, joint="curve")


def dashed(draw: ImageDraw.ImageDraw, start: Pixel, end: Pixel) -> None:
    """From the robot to g*."""
    a, b = np.asarray(start), np.asarray(end)
    length = float(np.hypot(*(b - a)))
    for s in np.arange(0.0, length, 10 * FINE):
        ends = [a + (b - a) * min(1.0, at / length) for at in (s, s + 5 * FINE)]
        draw.line([(float(x), float(y)) for x, y in ends], fill=LOCAL_GOAL, width=3 * FINE // 2)


def chip(draw: ImageDraw.ImageDraw, left: Length, middle: Length, text: str, colour: str) -> None:
    """White words on a rounded ground, at the finished size."""
    letters = font(15)
    right = left + 20 + letters.getlength(text)
    draw.rounded_rectangle((left, middle - 11, right, middle + 11), radius=11, fill=colour)
    draw.text((left + 10, middle), text, fill="white", font=letters, anchor="lm")


def scale_bar(draw: ImageDraw.ImageDraw, right: Length, bottom: Length, scale: Length, longest: Length) -> None:
    """A round length in metres, at the finished size; `scale` in pixels per metre, `longest` in pixels."""
    length = max(m for m in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if m * scale <= longest or m == 0.1)
    left = right - length * scale
    draw.line([(left, bottom - 4), (left, bottom), (right, bottom), (right, bottom - 4)], fill=INK, width=2)
    draw.text(((left + right) / 2, bottom - 4), f"{length:g} m", fill=INK, font=font(13), anchor="ms")


def legend(width: int, prior: float, hint: bool) -> Image.Image:
    """The strip that says what is what, `width` pixels wide.

    Args:
        width: Of the film [pixel].
        prior: P_dead that means "no evidence".
        hint: Whether true walls show through the unknown.
    """
    strip = Image.new("RGB", (width * FINE, LEGEND_HEIGHT * FINE), "white")
    draw, letters = ImageDraw.Draw(strip), font(13 * FINE)
    y, x = LEGEND_HEIGHT * FINE / 2, MARGIN * FINE

    def unknown(xy: Pixel) -> None:
        box = (xy[0] - 7 * FINE, xy[1] - 6 * FINE, xy[0] + 7 * FINE, xy[1] + 6 * FINE)
        draw.rectangle(box, fill=look.UNKNOWN)
        if hint:
            draw.rectangle((*box[:2], box[0] + 5 * FINE, box[3]), fill=UNSEEN_WALL)

    entries = {
        "robot": lambda xy: robot(draw, xy, 0.0, 6),
        "local goal g*": lambda xy: diamond(draw, xy, 5.5),
        "goal": lambda xy: star(draw, xy, 7),
        "recovery": lambda xy: dot(draw, xy, 5, look.RECOVERY),
        "unknown": unknown,
    }
    for text, symbol in entries.items():
        symbol((x + 8 * FINE, y))
        draw.text((x + 20 * FINE, y), text, fill=INK, font=letters, anchor="lm")
        x += 36 * FINE + letters.getlength(text)
    draw.text((x, y), "P(dead end) 0", fill=INK, font=letters, anchor="lm")
    x = int(x + letters.getlength("P(dead end) 0") + 6 * FINE)
    end = int((width - MARGIN - 6) * FINE - letters.getlength("1"))
    steps = look.over_white(look.heat(np.linspace(0.0, 1.0, max(end - x, 2)), prior))
    draw.rectangle((x - 1, y - 6 * FINE - 1, end, y + 6 * FINE + 1), outline=UNSEEN_WALL)
    for k, colour in enumerate((steps * 255).astype(int).tolist()):
        draw.line([(x + k, y - 6 * FINE), (x + k, y + 6 * FINE)], fill=tuple(colour))
    draw.text((end + 6 * FINE, y), "1", fill=INK, font=letters, anchor="lm")
    return strip.reduce(FINE)
