"""The study of when prioritized replay helps: ``python -m benchmarks.study COMMAND``.

``protocol.py`` has its tables as data. It trains and evaluates through the application of the
scripts, ``examples/training``, which does not know it.
"""
