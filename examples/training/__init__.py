"""The training application of the scripts: settings, training, comparisons of many runs.

It puts the parts of :mod:`torchrl_mpfa` and the task of :mod:`mpfa_envs` together. What a pipeline
of your own would need is in those two packages. ``docs/run.md`` shows the parts in the order in
which a run meets them.
"""
