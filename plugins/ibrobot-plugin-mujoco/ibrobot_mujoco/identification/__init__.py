"""`ibrobot identify`: the parameters of a simulated arm, from recordings of a real one."""
