"""A benchmark with power: which replay learns the values of a fixed policy sooner.

Buffer and policy of a run are frozen, and critics learn from scratch with each replay method. What
they should have learned is known, and no luck of exploration is in it: a few seeds of some seconds
tell methods apart that hundreds of whole runs do not. ``docs/results/values.md`` has the results,
and how to test a signal or sampler of one's own in a minute.
"""

from benchmarks.values.arms import ARMS as ARMS
from benchmarks.values.frozen import FrozenBuffer as FrozenBuffer
from benchmarks.values.frozen import frozen_buffers as frozen_buffers
from benchmarks.values.learning import critic_values as critic_values
from benchmarks.values.learning import learn as learn
from benchmarks.values.running import compare as compare
