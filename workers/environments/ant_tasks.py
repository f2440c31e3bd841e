"""Numbers of AntMaze, AntTrap and the mazes of cells that hold in any physics. This module imports no JAX."""

from __future__ import annotations

from collections.abc import Iterator

from es_service.protocol.messages import Segment, TaskSpec
from es_service.protocol.options import choice

STEP_S = 0.05
"""Seconds of a control step."""
JOINTS = 8
RESET_NOISE = 0.1
"""Half-width of the uniform noise on joint angles (radians) and joint velocities (radians per second) at reset."""
BODIES = 14
"""Number of bodies of Gym's ant: world, torso, then (leg, aux, foot) of each leg. Only the torso and the feet can touch
anything with Brax's springs."""
FORCE_LIMIT = 1.0
"""Bound of the contact forces in the observation of AntTrap."""
WALL_RADIUS = 0.5
"""Half the thickness of a wall, in metres."""
ANT_CLEARANCE = 0.65
"""Least distance of an ant's torso from the middle of a wall, in metres.

It is half the width of a wall plus the torso's radius, minus the 0.1 m by which a wall may give way.
"""

MAZE_START = (-25.0, -25.0)
MAZE_GOAL = (35.0, -25.0)
MAZE_NEAR = 5.0
"""Distance from the goal, in metres, within which an episode of AntMaze that ends there succeeds."""
MAZE_BOUNDS = (-35.0, 40.0)
"""Bounds of the arena in x and in y; it is a square."""

TRAP_START = (0.0, 0.0)
TRAP_HEALTHY_Z = (0.2, 1.0)
"""Range of the torso's height, in metres; an episode of AntTrap ends outside of it."""
TRAP_SURVIVAL_REWARD = 1.0
TRAP_BEYOND_X = 20.0
"""x of the torso, in metres, beyond which an episode of AntTrap has succeeded."""
TRAP_CONTROL_COST, TRAP_CONTACT_COST = 0.5, 5e-4


# Mazes of cells with many goals, after JaxGCRL (Bortkiewicz et al. 2025, arXiv:2408.11052), in plain numbers.
#
# This module imports no JAX. A cell is 4 m wide. Row i and column j of a map have their middle at (4 i, 4 j) m, as
# there.

CELL_M = 4.0
NEAR_M = 0.5
"""Distance of the torso from the goal, in metres, below which a step counts as being there."""
HEALTHY_Z = (0.2, 1.0)
"""Range of the torso's height, in metres; an episode ends outside of it."""
BLOCK, START, GOAL = "#", "S", "."
MAZES = {
    "ant_u_maze": (
        "#####",
        "#S..#",
        "###.#",
        "#...#",
        "#####",
    ),
    "ant_big_maze": (
        "########",
        "#S.##..#",
        "#..#...#",
        "##...###",
        "#..#...#",
        "#.#..#.#",
        "#...#..#",
        "########",
    ),
    "ant_hardest_maze": (
        "############",
        "#S...#.....#",
        "#.##.#.#.#.#",
        "#......#...#",
        "#.####.###.#",
        "#..#.#.....#",
        "##.#.#.#.###",
        "#..#...#...#",
        "############",
    ),
}
"""Task -> its map: blocks, the cell where the ant starts, and all other cells, each of which is a goal."""
DRAWN = "drawn"
"""Value of `task.options.goal` with which each episode draws its goal."""
Place = tuple[float, float]


def place(cell: tuple[int, int]) -> Place:
    """Middle of a cell, in metres."""
    return CELL_M * cell[0], CELL_M * cell[1]


def cells_of(maze: str, mark: str) -> list[tuple[int, int]]:
    """(row, column) of the cells with a mark, row by row."""
    return [(i, j) for i, row in enumerate(MAZES[maze]) for j, here in enumerate(row) if here == mark]


def is_free(maze: str, x: float, y: float) -> bool:
    """Whether a place is in no block."""
    layout = MAZES[maze]
    i, j = round(x / CELL_M), round(y / CELL_M)
    return 0 <= i < len(layout) and 0 <= j < len(layout[0]) and layout[i][j] != BLOCK


def goals_of(maze: str) -> dict[str, Place]:
    """Name of each goal, ROW-COLUMN as in `3-1`, and where it is."""
    return {f"{i}-{j}": place((i, j)) for i, j in cells_of(maze, GOAL)}


def walls_of(maze: str) -> tuple[Segment, ...]:
    """The sides of blocks that face free cells, as segments inside of the blocks whose walls end where the blocks do.

    Sides in one line are one segment. Where two meet in an edge that juts out, it is as round as walls are thick, so
    that it ends up to 0.2 m before the edge of the block. Where two blocks touch only in an edge, there is a gap of 0.4
    m between them, through which no torso fits.
    """
    layout, found = MAZES[maze], []

    def is_block(cell: tuple[int, int]) -> bool:
        return layout[cell[0]][cell[1]] == BLOCK

    for axis in (0, 1):  # the walls stand across x, then across y
        for side in (-1, 1):
            for line in range(1, (len(layout), len(layout[0]))[axis] - 1):
                across = CELL_M * (line + 0.5 * side) + WALL_RADIUS * side

                def at(k: int, offset: int = 0, line: int = line, axis: int = axis) -> tuple[int, int]:
                    return (line + offset, k) if axis == 0 else (k, line + offset)

                length = (len(layout), len(layout[0]))[1 - axis]
                faces = [k for k in range(1, length - 1) if not is_block(at(k)) and is_block(at(k, side))]
                for first, last in _runs(faces):
                    # A corner between two walls is closed from within the blocks; an edge that juts out is not passed,
                    # nor one where two blocks touch each other.
                    closed = [is_block(at(k)) and is_block(at(k, side)) for k in (first - 1, last + 1)]
                    low = CELL_M * (first - 0.5) + WALL_RADIUS * (-1 if closed[0] else 1)
                    high = CELL_M * (last + 0.5) + WALL_RADIUS * (1 if closed[1] else -1)
                    ends = ((across, low), (across, high)) if axis == 0 else ((low, across), (high, across))
                    found.append(ends)
    return tuple(found)


def _runs(numbers: list[int]) -> Iterator[tuple[int, int]]:
    """First and last of each run of neighbours in ascending numbers."""
    start = 0
    for at in range(1, len(numbers) + 1):
        if at == len(numbers) or numbers[at] != numbers[at - 1] + 1:
            yield numbers[start], numbers[at - 1]
            start = at


def bounds_of(maze: str) -> tuple[Place, Place]:
    """(low, high) of x and of y of all cells but the outer blocks."""
    rows, columns = len(MAZES[maze]), len(MAZES[maze][0])
    return (0.5 * CELL_M, CELL_M * (rows - 1.5)), (0.5 * CELL_M, CELL_M * (columns - 1.5))


def goal_maze(maze: str) -> TaskSpec:
    goals = goals_of(maze)
    return TaskSpec(
        name=maze,
        observation_size=31,
        action_size=8,
        episode_steps=1000,
        descriptor_names=("x", "y"),
        descriptor_bounds=bounds_of(maze),
        final_fitness=False,
        has_goal=True,
        options={
            "goal": choice(DRAWN, *goals),
            "reward": choice("at_goal", "dense"),
            "observation": choice("with_goal", "without_goal"),
        },
        walls=walls_of(maze),
        wall_clearance=ANT_CLEARANCE,
        goals=goals,
        goal_radius=NEAR_M,
        success=f"the ant has been within {NEAR_M:g} m of the goal",
        least_reward=0.0,
        summary=f"an ant among walls must reach the goal of the episode, one of {len(goals)}, and stay there",
    )
