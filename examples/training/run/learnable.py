"""New worlds of the kinds in which there is most to learn."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

KINDS = ("rooms", "clutter", "bars", "fields", "halls", "mazes")
"""Generators of which the worlds are: those of ``mixed``."""
LEVELS = 3
"""Parts of the range of difficulties."""
_RATE = 0.1
"""Of the mean of the last episodes: it is of some ten of them."""
_UNIFORM = 0.2
"""Share of the worlds that are of any kind, so that no estimate is of long ago."""


class LearnableWorlds:
    r"""Chooses kinds of worlds by learnability, :math:`p (1 - p)`, with p the success there.

    What always or never succeeds teaches little. Rutherford et al. (2024),
    https://arxiv.org/abs/2408.15099, choose single worlds by it; here it is generators and thirds
    of their difficulties, as each world is new.

    Examples:
        >>> worlds = LearnableWorlds()
        >>> for _ in range(50):
        ...     worlds.note("rooms-7@0.1", success=True)
        >>> worlds.chances[0].item() < 0.02 < worlds.chances[1].item()
        True
    """

    def __init__(self) -> None:
        # Half of the episodes, until some have ended: each kind is as likely.
        self._success = torch.full((len(KINDS) * LEVELS,), 0.5, dtype=torch.double)

    @property
    def chances(self) -> Tensor:
        """Chance of each kind, its difficulties one after the other, shape ``[K * L]``."""
        learnable = self._success * (1.0 - self._success) + 1e-6
        uniform = torch.full_like(learnable, _UNIFORM / len(learnable))
        return uniform + (1.0 - _UNIFORM) * learnable / learnable.sum()

    def choose(self, rng: np.random.Generator) -> tuple[str, float]:
        """Choose generator and difficulty of a new world."""
        kind, level = divmod(int(rng.choice(len(self._success), p=self.chances.numpy())), LEVELS)
        return KINDS[kind], (level + rng.random()) / LEVELS

    def note(self, world: str, *, success: bool) -> None:
        """Take note of how an episode in a world ended.

        Args:
            world: Name of a world that was chosen here.
            success: Whether the goal was reached.
        """
        kind, difficulty = world.split("-")[0], float(world.partition("@")[2])
        place = KINDS.index(kind) * LEVELS + min(int(difficulty * LEVELS), LEVELS - 1)
        self._success[place] += _RATE * (float(success) - self._success[place])

    def state_dict(self) -> dict[str, Tensor]:
        """The estimates of success."""
        return {"success": self._success.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from what :meth:`state_dict` gave."""
        self._success = state["success"].clone()
