"""Planners, one in each file: they choose the next goal of a robot, or divide frontiers among the robots of a group.

`common` holds what several of them need. `random_goals` and `random_walk` are policies without a plan, the weakest
baselines. `agents.registry` lists all of them by name.
"""
