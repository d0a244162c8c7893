"""Launch: a plan of components from a robot YAML, and the runtime that starts, watches and stops them."""
