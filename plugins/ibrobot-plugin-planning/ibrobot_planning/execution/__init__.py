"""Modes with a planner: goals of services and commands become motions of the executors."""
