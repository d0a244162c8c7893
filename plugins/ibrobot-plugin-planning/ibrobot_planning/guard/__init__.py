"""The guard: keeps commands of every origin clear of the arm itself and of the world, in the control process."""
