"""An ant colony that searches for a short path on the grid of a known world."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count, check_number, check_positive, check_seed, check_share
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE
from mpfa_envs.worlds.shapes import Point

_MOST_MOVES: Final = 16
"""Greatest number of moves from a cell: straight, diagonal and a knight's."""


class AntColony:
    r"""Ant colony optimization with bounded pheromone, a :class:`~mpfa_envs.planners.Search`.

    In each iteration all ants walk from the start, cell by cell, each over cells where it has not
    been. An ant in cell :math:`i` goes to a neighbor :math:`j` with a probability proportional to
    :math:`\tau_{ij}\,\eta_{ij}^{\beta}`, where :math:`\tau` is the pheromone of the move and
    :math:`\eta_{ij} = e^{-(l_{ij} + h_j - h_i) / r}` falls with the detour of the move, of length
    :math:`l`: :math:`h` is the straight line to the goal, :math:`r` the side of a cell. An ant
    without such a neighbor goes back a step, so that each one arrives if there is a path.
    Loops are cut off its path wherever a later cell is next to an earlier one. Then the pheromone
    :math:`\tau \leftarrow (1 - \rho)\,\tau` evaporates and the shortest path so far, in every other
    iteration the shortest of the iteration, gets :math:`\rho` on each of its moves; it stays
    between a least value and one. That is the max-min ant system of Stützle and Hoos (2000,
    https://doi.org/10.1016/S0167-739X(00)00043-1) on a grid, with moves taken back.

    All ants take a step at once. The walk of an ant ends after two steps for each cell at the
    latest.

    Args:
        ants: Number of ants.
        iterations: Number of iterations.
        evaporation: Share ρ of the pheromone that evaporates in an iteration.
        greed: Exponent β of the path ahead.
        least_pheromone: Least pheromone of a move; the most is one.
        seed: Seed of the ants' choices; the same path is found each time.
        time_limit: No iteration begins later than this [s]. It is a guard: a search that it ends
            depends on the speed of the machine.

    Raises:
        ValueError: If a number is out of its range.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import AntColony, path_length
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25, resolution=0.25)
        >>> path = AntColony(seed=0)(grid, (0.0, 0.0), (4.0, 0.0))
        >>> path_length(grid, path) < 1.1 * grid.length((0.0, 0.0), (4.0, 0.0))
        True
    """

    def __init__(
        self,
        *,
        ants: int = 24,
        iterations: int = 30,
        evaporation: float = 0.2,
        greed: float = 2.0,
        least_pheromone: float = 0.02,
        seed: int = 0,
        time_limit: float = 20.0,
    ) -> None:
        self.ants = check_count("ants", ants)
        self.iterations = check_count("iterations", iterations)
        self.evaporation = check_share("evaporation", evaporation)
        self.greed = check_number("greed", greed)
        self.least_pheromone = check_share("least_pheromone", least_pheromone)
        self.seed = check_seed(seed)
        self.time_limit = check_positive("time_limit", time_limit)

    def __call__(self, grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
        """Find a path, as a :class:`~mpfa_envs.planners.Search`."""
        ends = time.perf_counter() + self.time_limit
        if not grid.free.any():
            return None
        rng = np.random.default_rng(self.seed)
        first, last = (_nearest(grid, place) for place in (start, goal))
        neighbors, lengths = moves_of_cells(grid)
        to_goal = np.hypot(*(_positions(grid) - _positions(grid)[last]).T)
        detours = lengths + np.append(to_goal, math.inf)[neighbors] - to_goal[:, None]
        visibility = np.exp(-self.greed * detours / grid.resolution)
        pheromone = np.ones_like(lengths)
        best: tuple[float, list[int]] = math.inf, []
        for iteration in range(self.iterations):
            paths = self._walk(neighbors, pheromone * visibility, first, last, rng)
            if not paths:
                return None
            measured = [_measured(_without_loops(path, neighbors), grid) for path in paths]
            found = min(measured)
            best = min(best, found)
            pheromone *= 1.0 - self.evaporation
            self._mark(pheromone, neighbors, (best if iteration % 2 else found)[1])
            np.clip(pheromone, self.least_pheromone, 1.0, out=pheromone)
            if time.perf_counter() > ends:
                break
        places = [(x, y) for x, y in _positions(grid)[best[1]].tolist()]
        return [start, *places, goal]

    def _walk(
        self,
        neighbors: NDArray[np.int64],
        attraction: NDArray[np.float64],
        first: int,
        last: int,
        rng: np.random.Generator,
    ) -> list[list[int]]:
        """Let the ants walk; paths of those that arrive, without the moves that they took back."""
        count, ants = len(neighbors), self.ants
        # One more cell, where no ant may go, stands for the neighbors that a cell lacks.
        visited = np.zeros((ants, count + 1), dtype=np.bool_)
        visited[:, count] = True
        visited[:, first] = True
        stacks = np.full((ants, count + 1), first, dtype=np.int64)
        depths = np.zeros(ants, dtype=np.int64)
        walking = np.arange(ants if first != last else 0)
        for _ in range(2 * count):
            if not len(walking):
                break
            cells = stacks[walking, depths[walking]]
            ahead = neighbors[cells]
            weights = np.where(visited[walking[:, None], ahead], 0.0, attraction[cells])
            sums = weights.cumsum(axis=1)
            total = sums[:, -1]
            moves = total > 0.0
            chosen = (sums <= (rng.random(len(walking)) * total)[:, None]).sum(axis=1)
            at = np.arange(len(walking))
            to = ahead[at, np.minimum(chosen, _MOST_MOVES - 1)]
            depths[walking] += np.where(moves, 1, -1)
            going = walking[moves]
            stacks[going, depths[going]] = to[moves]
            visited[going, to[moves]] = True
            # Back at the start with nowhere to go, there is no path.
            lost = depths[walking] < 0
            walking = walking[~lost & ~(moves & (to == last))]
        arrived = np.flatnonzero((depths >= 0) & (stacks[np.arange(ants), depths] == last))
        return [stacks[ant, : depths[ant] + 1].tolist() for ant in arrived]

    def _mark(
        self, pheromone: NDArray[np.float64], neighbors: NDArray[np.int64], path: list[int]
    ) -> None:
        """Put pheromone on the moves of a path."""
        cells, following = np.array(path[:-1], dtype=np.int64), np.array(path[1:], dtype=np.int64)
        pheromone[cells, (neighbors[cells] == following[:, None]).argmax(axis=1)] += (
            self.evaporation
        )


def _nearest(grid: FreeGrid, place: Point) -> int:
    """Number of the free cell nearest to a position."""
    cells, gaps = grid.around(place)
    return int(np.flatnonzero((grid.cells == cells[gaps.argmin()]).all(axis=1))[0])


def _positions(grid: FreeGrid) -> NDArray[np.float64]:
    """Centers of the free cells [m], ``[cells, 2]``."""
    return np.stack((grid.xs[grid.cells[:, 0]], grid.ys[grid.cells[:, 1]]), axis=1)


def moves_of_cells(grid: FreeGrid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Neighbors of each free cell and lengths of the moves [m], ``[cells, 16]``."""
    # A neighbor that a cell lacks has the number of cells as its number, infinitely far away.
    count = len(grid.cells)
    numbers = np.full(grid.free.shape, -1)
    numbers[grid.free] = np.arange(count)
    # Two more cells on each side, none of them free, so that no move leads out of the grid.
    numbers = np.pad(numbers, 2, constant_values=-1)
    columns, rows = (grid.cells[:, None] + 2).transpose(2, 0, 1)
    to, over, under = (
        numbers[columns + across, rows + up] for across, up in MOVES.T.reshape(3, 2, -1)
    )
    is_open = (to >= 0) & (over >= 0) & (under >= 0)
    lengths = np.sqrt((MOVES[:, :2] ** 2).sum(axis=1)) * (grid.resolution * STEP_SCALE)
    return np.where(is_open, to, count), np.where(is_open, lengths, math.inf)


def _without_loops(path: list[int], neighbors: NDArray[np.int64]) -> list[int]:
    """Go from each cell of a path straight to the last of its cells that is a neighbor."""
    place = {cell: number for number, cell in enumerate(path)}
    short, at = [path[0]], 0
    while at < len(path) - 1:
        at = max(place.get(cell, 0) for cell in neighbors[path[at]].tolist())
        short.append(path[at])
    return short


def _measured(path: list[int], grid: FreeGrid) -> tuple[float, list[int]]:
    """Length of a path [m], and the path."""
    steps = np.diff(_positions(grid)[path], axis=0)
    return float(np.hypot(*steps.T).sum()), path
