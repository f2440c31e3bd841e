"""Replays in a page: recorded episodes in three dimensions for tasks with bodies, else as a path in the plane.

Poses are stored as 16-bit integers: positions in steps of the recording's own range (a millimetre for a way of 65 m),
quaternions in steps of 1/32767. The page turns them back into numbers and draws them; nothing is computed there that is
reported. Distances of the camera, of the grid and of marks follow from the size of the body that moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from es_service.errors import ServiceError
from es_service.protocol.recordings import Mesh, Scene, Shape
from es_service.protocol.sources import task_code, user_path
from es_service.report import floor
from es_service.report.data import RunData
from es_service.report.markup import Markup, packed, spread, tag
from es_service.report.page import asset, section
from es_service.report.summary import number
from es_service.runs.replay import CERTIFIED, Replay, record

MOST_CELLS = 8
"""Elites that are replayed in one page, besides the best centre; each ant takes half a megabyte."""
SPEEDS = (0.25, 0.5, 1, 2, 4, 8)
HELP = "Drag to turn; scroll or pinch to zoom; drag with the right button or with two fingers to move."
PLAIN_STEP_S = 0.05
"""Seconds of a step in the replay of a task that has no time of its own."""
STILL = 1e-4
"""Metres, and differences of quaternions, by which a link may differ in an episode in which it does not move."""


def replay_section(
    data: RunData, *, best: bool, cells: Sequence[Sequence[int]], trusted: bool, certified: bool = False
) -> Mapping[str, Any]:
    """The section of the page, the data of its script, and the libraries that it needs.

    A task that cannot be run on this machine, such as a user's task whose package is missing, has a section that says
    so. Errors about policies that the run does not have are raised: NotInRunError.

    Args:
        trusted: whether code that the config of the run names may be executed, without which such a run has no replay.
    """
    run = data.status.run
    for place in cells:
        run.cell(place)
    if certified:
        run.policy("certified")
    task, search = run.present_config["task"], run.present_config["search"]
    names = (*task_code(task["environment"], task.get("descriptor"), task.get("options", {})), search["algorithm"])
    if not trusted and (code := [name for name in names if user_path(name)]):
        return _no_replay(
            f"A replay would execute {' and '.join(code)}, which the config of this run names. If you trust its "
            "author, ask for the replay by its name: best, certified, or a cell."
        )
    try:
        replays, recorded = record(run, best=best, cells=cells, certified=certified)
    except ServiceError as error:
        return _no_replay(f"No episode could be recorded on this machine: {error.sentence}")
    scene = recorded.scene if recorded.scene and recorded.scene.shapes else None
    scripts = {"replay": _flat(data, replays) if scene is None else _solid(data, replays, scene)}
    libraries = [] if scene is None else [asset("three.bundle.js")]
    return {
        "section": _section(data, replays, scene),
        "scripts": scripts,
        "libraries": [*libraries, asset("replay.js")],
    }


def _no_replay(text: str) -> Mapping[str, Any]:
    return {
        "section": section("Replay", tag("p", text, class_="problem"), id_="replay"),
        "scripts": {},
        "libraries": [],
    }


def _title(replay: Replay) -> str:
    names = {"best": "best centre", CERTIFIED: "certified policy"}
    name = names.get(replay.candidate.name, f"cell {replay.candidate.name}")
    return f"{name}: fitness {number(replay.recording.fitness)} in this episode"


def _notes(replay: Replay, hidden: str | None) -> Markup:
    """Which episode is shown, and how it compares with what the run has stored of it."""
    stored, shown = replay.stored, number(replay.recording.fitness)
    seen = f"{replay.recording.returns_T.size - 1:,} steps, fitness {shown}"
    mean = f"(mean of all its evaluation episodes: {number(replay.candidate.stored_fitness)})"
    if stored is None:
        if np.isfinite(replay.candidate.stored_fitness):
            text = "The run does not have the address of this policy's evaluation episodes, so this is another episode "
            text += f"of the policy: {seen} {mean}."
        else:
            text = "This run is a fork whose settings have changed the meaning of fitness, so earlier evaluations of "
            text += f"the policy do not count. This is an episode with the settings of this run: {seen}."
        return tag("p", text, class_="note episode", hidden=hidden)
    text = f"First evaluation episode of the policy, of generation {replay.candidate.generation:,}: {seen} {mean}."
    if stored.certification is not None:
        text = f"Episode {stored.request.episode:,} of certification {stored.certification}, which is the one of "
        text += f"median fitness: {seen} (mean of all its episodes: {number(replay.candidate.stored_fitness)})."
    if replay.is_the_stored:
        same = "Its fitness equals the stored one bit for bit."
        if stored.trace_T_B is not None:
            same = "Its fitness and its path equal the stored ones bit for bit."
        return tag("p", f"{text} {same}", class_="note episode", hidden=hidden)
    other = (
        f"This is not the stored episode, whose fitness is {stored.fitness!r} instead of {replay.recording.fitness!r}."
    )
    if stored.changes:
        why = f"What has changed since it was computed may give other bits: {'; '.join(stored.changes)}."
        return tag("p", f"{text} {other} {why}", class_="note episode", hidden=hidden)
    why = "Packages, processor and code are those that computed it, so this is an error; please report it."
    return tag("p", f"{text} {other} {why}", class_="problem episode", hidden=hidden)


def _section(data: RunData, replays: Sequence[Replay], scene: Scene | None) -> Markup:
    options = [tag("option", _title(replay), value=index) for index, replay in enumerate(replays)]
    speeds = [tag("option", f"{speed:g} x", value=speed, selected="" if speed == 1 else None) for speed in SPEEDS]
    longest = max(replay.recording.returns_T.size for replay in replays) - 1
    scrub = Markup(f'<input type="range" id="scrub" min="0" max="{longest}" value="0" step="1" aria-label="step">')
    # Walls are seen best from afar, a body on its own from nearby.
    follow = Markup(f'<input type="checkbox" id="follow"{"" if data.task.walls else " checked"}>')
    frame = _frame(data, replays)
    plan = tag("svg", floor.ground(frame, _labels(data, replays)), floor.walls_and_goal(frame, data.task),
               tag("g", class_="path"), viewBox="0 0 {:.0f} {:.0f}".format(*floor.size(frame)), class_="map",
               role="img", aria_label="Path from above")  # fmt: skip
    stage = None if scene is None else tag("div", tag("canvas", id="stage"), class_="stage", id="stage-box")
    return section(
        "Replay",
        tag(
            "div",
            tag("select", *options, id="episode", aria_label="episode"),
            tag("button", "Play", id="play", type="button"),
            scrub,
            tag("label", "speed ", tag("select", *speeds, id="speed")),
            None if scene is None else tag("label", follow, " follow"),
            class_="controls",
        ),
        tag("p", id="step", class_="readout"),
        stage,
        tag("div", plan, class_="stage flat", id="plan", hidden=None if scene is None else ""),
        *(_notes(replay, "" if i else None) for i, replay in enumerate(replays)),
        *(tag("p", text, class_="note") for text in (() if scene is None else (HELP, *scene.notes))),
        id_="replay",
    )


def _labels(data: RunData, replays: Sequence[Replay]) -> tuple[str, str]:
    first, *others = data.names
    if _bodies_way(data, replays[0]) is not None:
        return "x", "y"
    return (first, others[0]) if others else ("step of the episode", first)


def _bodies_way(data: RunData, replay: Replay) -> np.ndarray | None:
    """[T, 3] path of the body, if the task has one and the descriptor is no place on the floor."""
    poses_T_L_7 = replay.recording.poses_T_L_7
    if poses_T_L_7 is None or floor.is_plan(data.task, data.names):
        return None
    return poses_T_L_7[:, followed_link(poses_T_L_7), :3]


def followed_link(poses_T_L_7: np.ndarray) -> int:
    """The first link that moves or turns, as the bases of robots do and the things around them do not."""
    return int((np.ptp(poses_T_L_7, axis=0) > STILL).any(axis=1).argmax())


def _plane(data: RunData, replay: Replay) -> tuple[np.ndarray, np.ndarray]:
    """x and y of a path in the plane: of a body, or the first two dimensions, or one dimension against time."""
    way_T_B = replay.recording.descriptor_T_B
    if (way_T_3 := _bodies_way(data, replay)) is not None:
        return way_T_3[:, 0], way_T_3[:, 1]
    if way_T_B.shape[1] == 1:
        return np.arange(len(way_T_B), dtype=float), way_T_B[:, 0]
    return way_T_B[:, 0], way_T_B[:, 1]


def _frame(data: RunData, replays: Sequence[Replay]) -> Any:
    if floor.is_plan(data.task, data.names):
        return floor.plan_frame(data.bounds)
    ways = [_plane(data, replay) for replay in replays]
    return floor.plan_frame((spread([x for x, _ in ways]), spread([y for _, y in ways])))


def _flat(data: RunData, replays: Sequence[Replay]) -> dict[str, Any]:
    """Paths in tenths of a pixel of the floor plan."""
    frame = _frame(data, replays)
    episodes = []
    for replay in replays:
        x, y = _plane(data, replay)
        way = np.stack([frame.across(np.clip(x, *frame.x)), frame.down(np.clip(y, *frame.y))], axis=1)
        returns = [number(float(value)) for value in replay.recording.returns_T]
        episodes.append({"steps": len(way) - 1, "way": packed(10 * way, "int16"), "returns": returns})
    return {"solid": False, "step_s": PLAIN_STEP_S, "episodes": episodes}


def _solid(data: RunData, replays: Sequence[Replay], scene: Scene) -> dict[str, Any]:
    """Poses of all links, and the shapes that move with them."""
    flat = _flat(data, replays)
    for replay, episode in zip(replays, flat["episodes"], strict=True):
        poses = _poses(replay)
        low, high = poses[..., :3].min(axis=(0, 1)), poses[..., :3].max(axis=(0, 1))
        size = np.maximum(high - low, 1e-6) / 65535.0
        episode |= {
            "low": low.tolist(),
            "size": size.tolist(),
            "positions": packed((poses[..., :3] - low) / size, "uint16"),
            "rotations": packed(poses[..., 3:] * 32767.0, "int16"),
        }
    first = _poses(replays[0])
    reach, goal = reach_of(first, scene), data.task.goal
    floors = [shape.position[2] for shape in scene.shapes if is_floor(shape)]
    return flat | {
        "solid": True,
        "step_s": scene.step_s,
        "links": first.shape[1],
        "followed": followed_link(first),
        "reach": reach,
        "floor": max(floors) if floors else None,
        "ground": max(floors) if floors else float(min(_poses(replay)[..., 2].min() for replay in replays)),
        "shapes": [{**shape._asdict(), "floor": is_floor(shape)} for shape in scene.shapes],
        "meshes": [packed_mesh(mesh) for mesh in scene.meshes],
        "goal": None if goal is None else list(goal),
        "goal_radius": 0.0 if goal is None else goal_radius(goal, first[0, followed_link(first), :2], reach),
    }


def _poses(replay: Replay) -> np.ndarray:
    """[T, L, 7] poses in double precision; 0 where they are not finite."""
    return np.nan_to_num(np.asarray(replay.recording.poses_T_L_7, np.float64), posinf=0.0, neginf=0.0)


def goal_radius(goal: Sequence[float], start_2: np.ndarray, reach: float) -> float:
    """Metres of the mark of a goal: seen from far where the way is long, and small beside an arm that reaches it."""
    return float(np.clip(0.0135 * np.hypot(*(np.asarray(goal) - start_2)), 0.06 * reach, 0.65 * reach))


def packed_mesh(mesh: Mesh) -> dict[str, Any]:
    """A mesh with vertices in steps of 1/32767 of its extent."""
    unit = max(float(np.abs(mesh.vertices_V_3).max()), 1e-9) / 32767.0
    triangles = packed(mesh.triangles_F_3, "uint32")
    return {"unit": unit, "vertices": packed(mesh.vertices_V_3 / unit, "int16"), "triangles": triangles}


def is_floor(shape: Shape) -> bool:
    """Whether a shape is a plane of the world whose upper side is up."""
    _, x, y, _ = shape.rotation
    return shape.kind == "plane" and shape.link < 0 and 1.0 - 2.0 * (x * x + y * y) > 0.9999


def reach_of(poses_T_L_7: np.ndarray, scene: Scene) -> float:
    """Metres from the followed link at the start to the farthest end of a shape that moves, at most."""
    start_L_3, moves_L = poses_T_L_7[0, :, :3], (np.ptp(poses_T_L_7, axis=0) > STILL).any(axis=1)
    centre_3 = start_L_3[followed_link(poses_T_L_7)]
    ends = [
        np.linalg.norm(start_L_3[shape.link] - centre_3) + np.linalg.norm(shape.position) + np.linalg.norm(shape.size)
        for shape in scene.shapes
        if shape.link >= 0 and moves_L[shape.link]
    ]
    return float(max(ends, default=1.0))
