"""Methods of others that the paper compares with, reconstructed: what little is published of them.

``reconstructions.py`` is the plugin that registers all of them.
"""

from benchmarks.paper.methods.averaged_ddpg import AveragedDDPG
from benchmarks.paper.methods.ddpg_radam import Curious
from benchmarks.paper.methods.hvper import HVPER
from benchmarks.paper.methods.klper import KLPER
from benchmarks.paper.methods.mw import MW
from torchrl_mpfa.methods import Method

RECONSTRUCTIONS: dict[str, Method] = {
    method.name: method for method in (KLPER(), AveragedDDPG(), HVPER(), Curious(), MW())
}
"""The methods by name; to import them registers none."""
