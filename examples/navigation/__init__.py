"""The training application of ``train.py`` and ``compare.py``: settings, loop, files, studies.

It puts the parts of :mod:`torchrl_mpfa` and the task of :mod:`mpfa_envs` together. What a pipeline
of your own would need is in those two packages.
"""
