"""Names of the package that went say what replaces them."""

from pathlib import Path

import pytest

from torchrl_mpfa.lazy import GONE

PAGE = Path(__file__).parents[2] / "docs" / "from_0_4.md"


@pytest.mark.parametrize("name", GONE)
def test_name_that_went_says_what_replaces_it(name):
    package, _, last = name.rpartition(".")
    with pytest.raises(ImportError, match=f"{last} is no longer there since 0.5: use ") as error:
        exec(f"from {package} import {last}", {})
    assert GONE[name] in str(error.value)
    assert last in PAGE.read_text(encoding="utf-8")
