"""Names that a package finds when they are used: lazily imported ones, and old ones, which warn."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

TOP: Final[dict[str, str]] = {
    "Annealed": "torchrl_mpfa.moving_fusion.Annealed",
    "BatchFacts": "torchrl_mpfa.adjustment.BatchFacts",
    "Counting": "torchrl_mpfa.adjustment.Counting",
    "DirectModule": "torchrl_mpfa.networks.DirectModule",
    "Draw": "torchrl_mpfa.selection.SampledBatch",
    "QLearner": "torchrl_mpfa.TabularQLearner",
    "Selection": "torchrl_mpfa.selection.Selection",
    "SignalLoss": "torchrl_mpfa.losses.SignalLoss",
    "SignalTable": "torchrl_mpfa.storages.SignalTable",
    "TreeSampler": "torchrl_mpfa.samplers.TreeSampler",
    "load_safely": "torchrl_mpfa.saving.load_safely",
    "make_value_table": "torchrl_mpfa.networks.make_value_table",
    "one_batch": "torchrl_mpfa.selection.one_batch",
    "save_atomically": "torchrl_mpfa.saving.save_atomically",
    "write_text_atomically": "torchrl_mpfa.saving.write_text_atomically",
}
"""Names that were in :mod:`torchrl_mpfa`, and where they are."""
OF_SELECTION: Final[dict[str, str]] = {"Draw": "torchrl_mpfa.selection.SampledBatch"}
"""Names that were in :mod:`torchrl_mpfa.selection`, and where they are."""
OF_METHODS: Final[dict[str, str]] = {
    "CappedSampler": "torchrl_mpfa.methods.mw.MWSampler",
    "CombinedSampler": "torchrl_mpfa.methods.cer.CERSampler",
    "Curiosity": "torchrl_mpfa.methods.curiosity.Curiosity",
    "ENDED": "torchrl_mpfa.methods.reaper.ENDED",
    "EPISODE": "torchrl_mpfa.methods.reaper.EPISODE",
    "GeometricSampler": "torchrl_mpfa.methods.geometric.GeometricSampler",
    "LA3PSampler": "torchrl_mpfa.methods.la3p.LA3PSampler",
    "LowestDivergence": "torchrl_mpfa.methods.klper.KLPERSelection",
    "PriorityFloor": "torchrl_mpfa.methods.lap.LAPFloor",
    "RELATIVE_ERROR": "torchrl_mpfa.methods.hvper.RELATIVE_ERROR",
    "RELATIVE_VALUE": "torchrl_mpfa.methods.hvper.RELATIVE_VALUE",
    "RankSampler": "torchrl_mpfa.methods.rank_per.RankPERSampler",
    "ReaPERSampler": "torchrl_mpfa.methods.reaper.ReaPERSampler",
    "RememberForget": "torchrl_mpfa.methods.ref_er.ReFERSelection",
    "RememberingSampler": "torchrl_mpfa.methods.ref_er.ReFERSampler",
    "ReplayPenalty": "torchrl_mpfa.methods.hvper.HVPERPenalty",
    "gaussian_divergence": "torchrl_mpfa.methods.klper.gaussian_divergence",
    "geometric_age": "torchrl_mpfa.methods.geometric.geometric_age",
    "importance_ratio": "torchrl_mpfa.methods.ref_er.importance_ratio",
    "intrinsic_reward": "torchrl_mpfa.methods.curiosity.intrinsic_reward",
    "rank_share": "torchrl_mpfa.methods.rank_per.rank_share",
    "relative_error": "torchrl_mpfa.methods.hvper.relative_error",
    "relative_value": "torchrl_mpfa.methods.hvper.relative_value",
    "reliability": "torchrl_mpfa.methods.reaper.reliability",
    "split_draws": "torchrl_mpfa.methods.la3p.la3p_batches",
    "uniform_halves": "torchrl_mpfa.methods.halves.uniform_halves",
    "value_schedule": "torchrl_mpfa.methods.hvper.value_schedule",
}
"""Names that were in :mod:`torchrl_mpfa.methods`, and where they are."""
OF_LEARNERS: Final[dict[str, str]] = {
    "CompilableLearner": "torchrl_mpfa.learners.ActorCriticLearner",
    "QLearner": "torchrl_mpfa.learners.TabularQLearner",
}
"""Names that were in :mod:`torchrl_mpfa.learners`, and where they are."""
OF_CLIFFWALK: Final[dict[str, str]] = {
    "batch_size_of": "benchmarks.study.cliffwalk.batch_size_of",
    "oracle_updates": "benchmarks.study.cliffwalk.oracle_updates",
}
"""Names that were in :mod:`torchrl_mpfa.cliffwalk`, and are not in the package any more."""


def find(
    package: str, name: str, renamed: Mapping[str, str], module_of: Mapping[str, str] | None = None
) -> Any:
    """What a package has by a name: from a module, or a module; old names stay for one version.

    Raises:
        AttributeError: If there is no such name, or it is not in the package any more.
    """
    if module_of and name in module_of:
        return getattr(import_module(f"{package}.{module_of[name]}"), name)
    if name not in renamed:
        # A module is an attribute of its package only once it was imported.
        if "__path__" in vars(sys.modules[package]) and find_spec(f"{package}.{name}"):
            return import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    module, _, new = renamed[name].rpartition(".")
    message = f"{package}.{name} is now {renamed[name]}"
    if module.partition(".")[0] != "torchrl_mpfa":
        raise AttributeError(f"{message}, which is not installed with the package")
    warnings.warn(message, DeprecationWarning, stacklevel=3)
    return getattr(import_module(module), new)
