"""Numbers of AntMaze and AntTrap that hold in any physics. This module imports no JAX."""

from __future__ import annotations

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
