"""PointMaze once more, one scalar at a time, from the published rules (QDax v0.3.0), float64."""

import math

GOAL_X, GOAL_Y = -0.5, 0.8


def clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def step(x: float, y: float, action: tuple[float, float]) -> tuple[float, float, float, bool]:
    """One move: (x, y, reward, done)."""
    new_x = x + clip(action[0], -1.0, 1.0) / 10
    new_y = y + clip(action[1], -1.0, 1.0) / 10
    old_y, uncorrected_y = y, new_y

    def x_where(height: float) -> float:
        return x + (new_x - x) * (height - old_y) / (uncorrected_y - old_y)

    # Lower wall: y in [-0.50, -0.49], standing on x >= -0.5.
    if old_y <= -0.5 < new_y and x_where(-0.5) >= -0.5:
        new_y = -0.5
    elif -0.49 <= old_y < 0.2 and new_y < -0.49 and x_where(-0.5) >= -0.5:
        new_y = -0.49
    # Upper wall: y in [0.20, 0.21], standing on x <= 0.5.
    if old_y >= 0.21 > new_y and x_where(0.2) <= 0.5:
        new_y = 0.21
    elif -0.5 < old_y <= 0.2 < new_y and x_where(0.2) <= 0.5:
        new_y = 0.2
    new_x, new_y = clip(new_x, -1.0, 1.0), clip(new_y, -1.0, 1.0)
    distance = math.hypot(new_x - GOAL_X, new_y - GOAL_Y)
    done = abs(new_x - GOAL_X) <= 0.05 and abs(new_y - GOAL_Y) <= 0.05
    return new_x, new_y, -distance, done
