"""Where does plain ES end on PointMaze? Seeds 0 to 4, all reported, with the shipped config.

    python -m tests.benchmarks.science_es [--generations 300]

Writes results/point_maze_es.csv (one row per seed) and results/point_maze_es.svg (the maze with the way of each seed's
best centre, and the centre's return against environment steps).
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

import numpy as np

from es_service import api
from es_service.noise import Domain, stream_keys
from es_service.platform_info import cpu_kind
from es_service.run_view import Policy, Run
from workers.environments import make_environment
from workers.environments import point_maze as maze

RESULTS = Path(__file__).parent / "results"
CONFIG = Path(__file__).parents[2] / "configs" / "point_maze_es.yaml"
SEEDS = range(5)
COLOURS = ("#1b6ca8", "#d1495b", "#2e7d32", "#8e5ea2", "#c77d0a")


def trajectory(policy: Policy, seed: int) -> np.ndarray:
    """Positions of one episode of a policy in the task itself, [T + 1, 2]."""
    environment = make_environment("point_maze", {})
    state = environment.reset(stream_keys(seed, Domain.EVALUATION_RESET, 0, 0))
    positions = [np.asarray(state)]
    for _ in range(200):
        state, _, done = environment.step(state, policy(np.asarray(state)))
        positions.append(np.asarray(state))
        if done:
            break
    return np.array(positions)


def reached(run: Run, threshold: float) -> int | None:
    """Environment steps at the first generation whose centre was at least `threshold` good."""
    history = run.history
    good = history[history["centre_fitness_mean"] >= threshold]
    return int(good["env_steps"].iloc[0]) if len(good) else None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--generations", type=int, default=300)
    generations = parser.parse_args().generations
    rows, ways, curves = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in SEEDS:
            config = api.load_config(CONFIG, [f"seed={seed}", f"budget.generations={generations}"])
            run = api.run(config, Path(folder) / str(seed)).run
            last = run.history.iloc[-1]
            rows.append(
                {
                    "seed": seed,
                    "generations": generations,
                    "env_steps": int(last["env_steps"]),
                    "best_return": round(last["best_fitness"], 2),
                    "last_return_mean": round(last["centre_fitness_mean"], 2),
                    "last_return_std": round(last["centre_fitness_std"], 2),
                    "last_x": round(last["centre_x"], 3),
                    "last_y": round(last["centre_y"], 3),
                    "steps_to_minus_128": reached(run, -128.0),
                    "steps_to_minus_30": reached(run, -30.0),
                    "wall_clock_s": round(last["wall_clock_s"], 1),
                    "workers": int(last["workers"]),
                    "cpu": cpu_kind(),
                }
            )
            print(rows[-1], flush=True)
            ways.append(trajectory(run.policy("best"), seed))
            curves.append(run.history[["env_steps", "centre_fitness_mean"]].to_numpy())
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "point_maze_es.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    (RESULTS / "point_maze_es.svg").write_text(picture(ways, curves))


def picture(ways: list[np.ndarray], curves: list[np.ndarray]) -> str:
    """Two panels as SVG text: the maze from above with one way per seed; return against environment steps."""
    body = [*_maze_panel(ways, 40, 40, 360), *_curve_panel(curves, 500, 40, 440, 360)]
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 980 450" font-family="sans-serif" font-size="13">',
            '<rect width="980" height="450" fill="white"/>',
            *body,
            "</svg>\n",
        ]
    )


def _maze_panel(ways: list[np.ndarray], left: float, top: float, size: float) -> list[str]:
    def place(x: float, y: float) -> tuple[float, float]:
        return left + (x + 1) / 2 * size, top + (1 - y) / 2 * size

    def box(x0: float, y0: float, x1: float, y1: float, style: str) -> str:
        (a, b), (c, d) = place(x0, y1), place(x1, y0)
        return f'<rect x="{a:.1f}" y="{b:.1f}" width="{c - a:.1f}" height="{d - b:.1f}" {style}/>'

    half = maze.GOAL_HALF_SIDE
    parts = [
        f'<text x="{left}" y="{top - 14}">PointMaze: ways of the best centre of ES, seeds 0 to 4</text>',
        box(-1, -1, 1, 1, 'fill="#fafafa" stroke="#333"'),
        box(maze.START_X[0], maze.START_Y[0], maze.START_X[1], maze.START_Y[1], 'fill="#dfe7ee"'),
        box(maze.GOAL[0] - half, maze.GOAL[1] - half, maze.GOAL[0] + half, maze.GOAL[1] + half, 'fill="#7bc47f"'),
        box(maze.LOWER_WALL_FROM_X, maze.LOWER_WALL[0], 1, maze.LOWER_WALL[1], 'fill="#333" stroke="#333"'),
        box(-1, maze.UPPER_WALL[0], maze.UPPER_WALL_TO_X, maze.UPPER_WALL[1], 'fill="#333" stroke="#333"'),
    ]
    for way, colour in zip(ways, COLOURS, strict=True):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*position) for position in way))
        end_x, end_y = place(*way[-1])
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
        parts.append(f'<circle cx="{end_x:.1f}" cy="{end_y:.1f}" r="4" fill="{colour}"/>')
    x, y = place(*maze.GOAL)
    parts.append(f'<text x="{x + 16:.1f}" y="{y + 5:.1f}">goal</text>')
    x, y = place(0.12, -0.93)
    parts.append(f'<text x="{x:.1f}" y="{y:.1f}">start</text>')
    return parts


def _curve_panel(curves: list[np.ndarray], left: float, top: float, width: float, height: float) -> list[str]:
    low, high, most = -300.0, 0.0, max(curve[-1, 0] for curve in curves)

    def place(steps: float, value: float) -> tuple[float, float]:
        return left + steps / most * width, top + (high - max(value, low)) / (high - low) * height

    parts = [f'<text x="{left}" y="{top - 14}">return of the centre (mean of 30 episodes)</text>']
    for value in (-300, -200, -126.4, -24, 0):
        _, y = place(0, value)
        dash = ' stroke-dasharray="4 3"' if value in (-126.4, -24) else ""
        parts.append(f'<line x1="{left}" x2="{left + width}" y1="{y:.1f}" y2="{y:.1f}" stroke="#bbb"{dash}/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    _, y = place(0, -24)
    parts.append(f'<text x="{left + width}" y="{y - 5:.1f}" text-anchor="end" fill="#666">best known</text>')
    _, y = place(0, -126.4)
    parts.append(f'<text x="{left + width}" y="{y - 5:.1f}" text-anchor="end" fill="#666">deceptive optimum</text>')
    for curve, colour in zip(curves, COLOURS, strict=True):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*row) for row in curve))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.4"/>')
    parts.append(f'<text x="{left}" y="{top + height + 20}">0</text>')
    label = f"{most / 1e6:.0f} M environment steps"
    parts.append(f'<text x="{left + width}" y="{top + height + 20}" text-anchor="end">{label}</text>')
    return parts


if __name__ == "__main__":
    main()
