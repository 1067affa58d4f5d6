"""What a robot senses: its lidar, the map that it makes of the scans, and the observation.

- A *ray* is one direction in which the lidar measures a distance, its range (``lidar``).
- A *scan* is the ranges of all rays at one moment, as a driver of a lidar reports them.
- A *sector* is an equal part of the field of view. The observation has one range of it: the least
  of its rays, their median, or that of a single ray (``observation``; for real scans ``sectors``).

The rays, the maps and the observations of many robots are computed in compiled loops, which are in
``lidar_loops``, ``map_loops`` and ``observation``.

| of | a simulated lidar | a real one |
|---|---|---|
| rays | ``lidar``, ``lidar_loops`` | ``scan`` |
| sectors | ``observation`` | ``sectors``, ``glances``: what a turn hides |
| maps | ``map_memory``, ``map_loops`` | the same, and ``hits``: what has gone |
| walls of a plan | ``standing`` | the same |

Sensors beside the lidar are in ``sensors``, mirror images of all in ``mirror``.
"""
