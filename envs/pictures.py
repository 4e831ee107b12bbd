"""States of classic control as pictures: lines with smooth edges, from each pixel's distance to them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from prefrl.types import Floats

INK, RED, BLUE = (np.array(c, np.float32) for c in ((60, 66, 74), (201, 79, 69), (72, 120, 176)))


def pendulum(state: Floats, size: int) -> Floats:
    """(size, size, 3): a rod that hangs at angle pi and stands at 0."""
    angle = state[0]
    picture = np.full((size, size, 3), 255.0, np.float32)
    stroke(picture, (0.0, 0.0), (-np.sin(angle), np.cos(angle)), 0.09, RED)
    stroke(picture, (0.0, 0.0), (0.0, 0.0), 0.04, INK)
    return picture


def cartpole(state: Floats, size: int) -> Floats:
    """(size, size, 3): a cart on a track of 4.8 metres. Off it, the cart stays at the picture's edge."""
    x, angle = float(np.clip(state[0] / 2.4, -1.25, 1.25)), state[2]
    picture = np.full((size, size, 3), 255.0, np.float32)
    stroke(picture, (-1.0, -0.42), (1.0, -0.42), 0.012, INK)
    stroke(picture, (x - 0.12, -0.3), (x + 0.12, -0.3), 0.09, BLUE)
    stroke(picture, (x, -0.3), (x + 0.8 * np.sin(angle), -0.3 + 0.8 * np.cos(angle)), 0.045, RED)
    return picture


def acrobot(state: Floats, size: int) -> Floats:
    """(size, size, 3): two links that hang at 0, and the line that the free end is to rise above."""
    first, second = state[0], state[0] + state[1]
    elbow = 0.65 * np.sin(first), -0.65 * np.cos(first)
    end = elbow[0] + 0.65 * np.sin(second), elbow[1] - 0.65 * np.cos(second)
    picture = np.full((size, size, 3), 255.0, np.float32)
    stroke(picture, (-1.4, 0.65), (1.4, 0.65), 0.012, INK)
    stroke(picture, (0.0, 0.0), elbow, 0.07, BLUE)
    stroke(picture, elbow, end, 0.07, RED)
    for joint in ((0.0, 0.0), elbow):
        stroke(picture, joint, joint, 0.035, INK)
    return picture


def mountain_car(state: Floats, size: int, goal: float) -> Floats:
    """(size, size, 3): a car in a valley from -1.2 to 0.6, and a flag at the goal, near the top."""
    picture = np.full((size, size, 3), 255.0, np.float32)
    ground = [_hill(x) for x in np.linspace(-1.2, 0.6, 25)]
    for begin, end in pairwise(ground):
        stroke(picture, begin, end, 0.012, INK)
    foot = _hill(goal)
    stroke(picture, foot, (foot[0], foot[1] + 0.35), 0.012, INK)
    stroke(picture, (foot[0] + 0.04, foot[1] + 0.31), (foot[0] + 0.12, foot[1] + 0.31), 0.035, BLUE)
    (x, y), tilt = _hill(state[0]), np.arctan(1.35 * np.cos(3 * state[0]))
    cos, sin = np.cos(tilt), np.sin(tilt)
    back, front = ((x + a * cos - 0.06 * sin, y + a * sin + 0.06 * cos) for a in (-0.08, 0.08))
    raised = -0.07 * sin, 0.07 * cos
    stroke(picture, (back[0] + raised[0], back[1] + raised[1]), (front[0] + raised[0], front[1] + raised[1]), 0.06, RED)
    for wheel in (back, front):
        stroke(picture, wheel, wheel, 0.045, INK)
    return picture


def _hill(x: float) -> tuple[float, float]:
    """Where the ground of the mountain car's valley is on the picture."""
    return 1.5 * (x + 0.3), 0.675 * float(np.sin(3 * x))


def finished(picture: Floats) -> np.ndarray:
    """uint8."""
    return np.rint(picture).astype(np.uint8)


def stroke(picture: Floats, begin: tuple[float, float], end: tuple[float, float], radius: float, ink: Floats) -> None:
    """Draw a line with round ends on a picture that shows [-1.5, 1.5] in both directions, y upwards."""
    size = len(picture)
    pixel = 3.0 / size
    rows, columns = (_span(begin[k] * sign, end[k] * sign, radius + pixel, size) for k, sign in ((1, -1.0), (0, 1.0)))
    across = (np.arange(size, dtype=np.float32) + 0.5) * pixel - 1.5
    dx, dy = across[None, columns] - begin[0], -across[rows, None] - begin[1]
    along = end[0] - begin[0], end[1] - begin[1]
    # The nearest point of the line, as a share of its length; the maximum is for a dot, which has none.
    share = np.clip((dx * along[0] + dy * along[1]) / max(along[0] ** 2 + along[1] ** 2, 1e-12), 0.0, 1.0)
    distance = np.hypot(dx - share * along[0], dy - share * along[1])
    cover = np.clip((radius - distance) / pixel + 0.5, 0.0, 1.0)[..., None]  # the edge fades over one pixel
    picture[rows, columns] += cover * (ink - picture[rows, columns])


def _span(a: float, b: float, margin: float, size: int) -> slice:
    """The pixels between two coordinates, and `margin` beyond."""
    low, high = ((x + 1.5) / 3.0 * size for x in (min(a, b) - margin, max(a, b) + margin))
    return slice(max(0, int(low)), max(0, min(size, int(high) + 1)))
