"""Table F of the study: TD3 on tasks of Gymnasium, with the replay of any method.

It trains without the navigation task, and shares its tables, figures and intervals.
"""
