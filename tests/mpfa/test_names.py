"""Names of the package that went say what replaces them."""

from pathlib import Path

import pytest

from torchrl_mpfa.lazy import GONE

PAGE = Path(__file__).parents[2] / "docs" / "from_0_4.md"


@pytest.mark.parametrize("name", GONE)
def test_name_that_went_says_what_replaces_it(name):
    with pytest.raises(ImportError, match=f"{name} is no longer there since 0.5: use ") as error:
        exec(f"from torchrl_mpfa import {name}", {})
    assert GONE[name] in str(error.value)
    assert name in PAGE.read_text(encoding="utf-8")
