"""Launch: the plan of a run's components, and the runtime that starts, monitors and stops them."""
