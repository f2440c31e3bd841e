"""Pictures of environments from above, in NumPy: walls, goal, where the episode is and which way it came.

They show the plane of a descriptor that is a place. Bodies are not drawn: MuJoCo's renderer would need OpenGL.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import TaskSpec

MODES = ("rgb_array",)
FRAMES_PER_SECOND = 20
"""Of a video in the tasks' own time: a step of an ant lasts 0.05 s."""
SIZE = 256
"""Height and width of a picture in pixels."""
FLOOR, WALL, GOAL, WAY, HERE = (250, 250, 248), (68, 68, 68), (46, 158, 79), (120, 160, 220), (200, 40, 40)
MARGIN = 0.03
"""Width beyond the bounds of the descriptor, as a part of the whole."""


def require_mode(mode: str | None) -> None:
    """Raise ValueError if there is no such `render_mode`."""
    if mode is not None and mode not in MODES:
        raise ValueError(
            f"render_mode = {mode!r}; must be None or 'rgb_array', a picture from above. No window is opened and no "
            "body is drawn, since MuJoCo's renderer needs OpenGL, which a machine may lack; es-service report shows "
            "episodes of a run in three dimensions"
        )


def modes_of(task: TaskSpec) -> list[str]:
    """Values of `render_mode` beside None: pictures if the descriptor of a task is a place in the plane."""
    is_place = len(task.descriptor_names) == 2 and (
        bool(task.walls) or task.goal is not None or task.descriptor_names == ("x", "y")
    )
    return list(MODES) if is_place else []


class Trails:
    """The ways of the current episodes of N environments, and pictures of them."""

    def __init__(self, task: TaskSpec, count: int) -> None:
        """Draw the floor. Raises ValueError if the descriptor of the task is no place in the plane."""
        if not modes_of(task):
            named = " ".join(task.descriptor_names)
            raise ValueError(
                f"render_mode = 'rgb_array' draws a descriptor that is a place (x, y), but that of {task.name} is "
                f"({named}); choose another one with task_options, or draw bodies with mujoco.Renderer, which needs "
                "OpenGL"
            )
        low, high = np.array(task.descriptor_bounds).T
        self._middle, self._extent = (low + high) / 2, float((high - low).max()) * (1 + 2 * MARGIN)
        self._ways: list[list[NDArray]] = [[] for _ in range(count)]
        half_pixel = self._extent / SIZE / 2
        at = (np.arange(SIZE) + 0.5) / SIZE - 0.5
        self._pixels = self._middle + self._extent * np.stack(np.meshgrid(at, -at), axis=-1)
        """Places of the pixels, [row, column, 2]; y goes up."""
        self._floor = np.full((SIZE, SIZE, 3), FLOOR, np.uint8)
        for start, end in task.walls or ():
            self._floor[self._from_segment(np.array(start), np.array(end)) <= 2 * half_pixel] = WALL
        if task.goal is not None:
            self._disc(self._floor, np.array(task.goal), GOAL, 10 * half_pixel)

    def begin(self, lane_M: NDArray[np.intp], place_M_2: NDArray) -> None:
        for lane, place in zip(lane_M.tolist(), place_M_2, strict=True):
            self._ways[lane] = [place.copy()]

    def move(self, lane_M: NDArray[np.intp], place_M_2: NDArray) -> None:
        for lane, place in zip(lane_M.tolist(), place_M_2, strict=True):
            self._ways[lane].append(place.copy())

    def forget(self) -> None:
        """Nobody knows where the environments are, until they have done a step."""
        self._ways = [[] for _ in self._ways]

    def frame(self, lane: int) -> NDArray[np.uint8]:
        picture, way = self._floor.copy(), self._ways[lane]
        if way:
            for column, row in self._line(way):
                picture[row, column] = WAY
            self._disc(picture, way[-1], HERE, self._extent / SIZE * 4)
        return picture

    def _from_segment(self, start: NDArray, end: NDArray) -> NDArray:
        along, from_start = end - start, self._pixels - start
        part = np.clip(from_start @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        return np.linalg.norm(from_start - part[..., None] * along, axis=-1)

    def _disc(self, picture: NDArray[np.uint8], place: NDArray, colour: tuple[int, int, int], radius: float) -> None:
        picture[np.linalg.norm(self._pixels - place, axis=-1) <= radius] = colour

    def _line(self, way: Sequence[NDArray]) -> NDArray[np.intp]:
        """Pixels (column, row) of a way, those outside of the picture left out."""
        scaled = (np.array(way, float) - self._middle) / self._extent * (1, -1)
        pixels = (np.nan_to_num(scaled, nan=9.0, posinf=9.0, neginf=9.0).clip(-9.0, 9.0) + 0.5) * SIZE
        steps = np.abs(np.diff(pixels, axis=0)).max(axis=1, initial=0.0)
        points = [pixels[:1]]
        for first, last, length in zip(pixels, pixels[1:], steps, strict=False):
            points.append(np.linspace(first, last, int(length) + 2)[1:])
        whole = np.floor(np.concatenate(points)).astype(np.intp)
        return whole[((whole >= 0) & (whole < SIZE)).all(axis=1)]
