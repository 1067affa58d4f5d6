"""Names of the package that went say what replaces them."""

from pathlib import Path

import pytest

from torchrl_mpfa.lazy import GONE

PAGE = Path(__file__).parents[2] / "docs" / "from_0_4.md"
LOSSES, LEARNERS, STORAGES = (f"torchrl_mpfa.{name}" for name in ("losses", "learners", "storages"))
PACKAGES = {
    "SignalStorageMixin": [STORAGES],
    "SignalTable": [STORAGES],
    "hydra": ["torchrl_mpfa.integrations"],
    "SignalLoss": [LOSSES],
    "MultiTensorSoftUpdate": [LEARNERS],
    "ReplayHistory": ["torchrl_mpfa", "torchrl_mpfa.history"],
    "make_value_table": ["torchrl_mpfa.networks"],
    "check_adjustment": ["torchrl_mpfa.testing"],
    "check_fusion": ["torchrl_mpfa.testing"],
}
"""Packages that a name was in, if that was not the first."""


@pytest.mark.parametrize("name", GONE)
def test_name_that_went_says_what_replaces_it(name):
    further = LEARNERS if name.endswith("Learner") else LOSSES
    for package in PACKAGES.get(name, ["torchrl_mpfa", further]):
        with pytest.raises(
            ImportError, match=f"{name} is no longer there since 0.5: use "
        ) as error:
            exec(f"from {package} import {name}", {})
        assert GONE[name] in str(error.value)
    assert name in PAGE.read_text(encoding="utf-8")
