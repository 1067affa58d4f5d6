"""Records of updates are made without examples of their results, in less than half of the time."""

from unittest.mock import patch

import pytest
from torch.fx.experimental.proxy_tensor import make_fx

from torchrl_mpfa.learners import compiled


def _record(function, **options):
    made = make_fx(function, **options)
    if options:  # What Inductor is given keeps its examples.
        return made

    def record(*values):
        with patch("torch.fx.experimental.proxy_tensor.set_meta", lambda proxy, value: proxy):
            return made(*values)

    return record


@pytest.fixture(autouse=True)
def no_examples(monkeypatch):
    """A program clears what PyTorch notes of each operation that it records."""
    monkeypatch.setattr(compiled, "make_fx", _record)
