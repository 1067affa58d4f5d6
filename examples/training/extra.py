"""Imported before all else by the scripts that need it: ends them where the extra is missing."""

from importlib.util import find_spec

_missing = [
    name for name in ("hydra", "matplotlib", "pandas", "tqdm", "wandb") if not find_spec(name)
]
if _missing:
    raise SystemExit(
        f"this script needs {', '.join(_missing)}: install the extra 'examples', see Install in "
        "the README"
    )
