"""Pictures of rooms, episodes and studies: one function a picture, none needs a display.

Names that begin with ``render_`` give a picture from above, an array of shape
``[height, width, 3]``, by Pillow alone; those that begin with ``plot_`` write a chart to a file by
matplotlib, which the extra ``pictures`` brings.
"""

from mpfa_envs.render.charts import draw_seeds, plot_histograms, plot_seeds
from mpfa_envs.render.film import (
    Film,
    Panel,
    drive_episode,
    film_episode,
    render_traces,
    write_animation,
)
from mpfa_envs.render.grids import observe_room, render_samples, render_values
from mpfa_envs.render.trajectories import (
    Outcome,
    render_methods,
    render_trajectories,
    shown_episodes,
)
from mpfa_envs.scene.canvas import tiled
from mpfa_envs.scene.colors import (
    FLOOR,
    GOAL,
    LINES,
    OBSTACLE,
    OUTCOMES,
    RIVAL,
    TRAIL,
    WALL,
    viridis,
)
from mpfa_envs.scene.scene import render_scene

__all__ = [
    "FLOOR",
    "GOAL",
    "LINES",
    "OBSTACLE",
    "OUTCOMES",
    "RIVAL",
    "TRAIL",
    "WALL",
    "Film",
    "Outcome",
    "Panel",
    "draw_seeds",
    "drive_episode",
    "film_episode",
    "observe_room",
    "plot_histograms",
    "plot_seeds",
    "render_methods",
    "render_samples",
    "render_scene",
    "render_traces",
    "render_trajectories",
    "render_values",
    "shown_episodes",
    "tiled",
    "viridis",
    "write_animation",
]
