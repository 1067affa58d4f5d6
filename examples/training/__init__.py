"""The training application of the scripts: settings, training, comparisons of many runs.

It puts the parts of :mod:`torchrl_mpfa` and the task of :mod:`mpfa_envs` together. What a pipeline
of your own would need is in those two packages. ``settings`` knows no other folder; ``run`` and
``comparison``, which starts the scripts as processes, import it. Shared modules lie here.
"""
