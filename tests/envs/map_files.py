"""Files of maps to read."""

import numpy as np
from PIL import Image

GOOD = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_map(folder, shades, **changes):
    """A map of some shades [rows, columns], with changed or missing keys."""
    if shades is not None:
        Image.fromarray(np.asarray(shades)).save(folder / "map.pgm", format="PPM")
    values = {**GOOD, **changes}
    lines = [f"{key}: {value}" for key, value in values.items() if value is not None]
    (folder / "map.yaml").write_text("\n".join(lines) + "\n")
    return folder / "map.yaml"
