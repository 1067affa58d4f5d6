"""The plugin of the paper's reconstructed methods, KLPER and others.

python examples/train.py --plugin benchmarks/paper/methods/reconstructions.py method=klper
"""

from benchmarks.paper.methods import RECONSTRUCTIONS
from torchrl_mpfa.methods import METHODS

METHODS.update(RECONSTRUCTIONS)
