"""The infos of many robots as gymnasium wants them: arrays by key, and a mask beside each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.env.robots import FLAGS, NUMBERS
from mpfa_envs.sensing.observation import INFO_TYPES

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MASKS = tuple(f"_{name}" for name in INFO_TYPES)
_KEYS = (*FLAGS, *NUMBERS, *_MASKS)


def gather_infos(
    flags: NDArray[np.bool_], numbers: NDArray[np.float64], chosen: NDArray[np.bool_] | None
) -> dict[str, Any]:
    """An array for each key of the info, and a mask of the chosen robots, each one's own.

    Args:
        flags: One row for each of :data:`~mpfa_envs.env.robots.FLAGS`, ``[3, N]``.
        numbers: One row for each of :data:`~mpfa_envs.env.robots.NUMBERS`, ``[15, N]``.
        chosen: Whose infos they are, ``[N]``; None: those of all robots.
    """
    # Rows of one table, as copies one by one would take longer than all the rest.
    masks = np.empty((len(_MASKS), flags.shape[1]), dtype=np.bool_)
    masks[:] = True if chosen is None else chosen
    return dict(zip(_KEYS, (*flags, *numbers, *masks), strict=True))


def final_infos(
    observations: NDArray[np.float32], infos: dict[str, Any], ended: NDArray[np.bool_]
) -> dict[str, Any]:
    """What the last step of episodes has shown, before new ones begin.

    Args:
        observations: Of all robots, ``[N, O]``.
        infos: Those of the robots whose episodes have ended.
        ended: Which these are, ``[N]``.
    """
    seen = np.full(len(ended), None, dtype=object)
    for index in np.flatnonzero(ended).tolist():
        seen[index] = observations[index].copy()
    return {"final_obs": seen, "_final_obs": ended, "final_info": infos, "_final_info": ended}
