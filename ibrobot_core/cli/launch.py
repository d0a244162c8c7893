"""`ibrobot launch`: run a robot, real or simulated, from its YAML."""

from __future__ import annotations

import attrs

from ibrobot_core.cli.options import ModeOptions
from ibrobot_core.cli.run import run_robot
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.options import option


@attrs.frozen(kw_only=True)
class Launch(ModeOptions):
    """Run a robot.

    CONFIG is a robot YAML: a path, or the name of one shipped with ibrobot or a plugin; so101 by default.
    --episodes counts episodes of a policy in simulation.

    Exits with 0 if the run succeeded, 1 if a component failed or a fault was raised, 2 for a wrong command line
    or YAML, 3 if an episode or goal did not succeed, 130 on a second Ctrl-C.
    """

    episodes: int | None = option(None, ge=1, typed="--episodes N", help="stop after this number of episodes")

    def __call__(self) -> None:
        robot = self.load(self.mode)
        self.check_end(robot, self.episodes)
        request = LaunchRequest(self.lockstep, self.seed, self.duration, self.episodes, self.goals)
        run_robot(robot, request, headless=self.headless, dry_run=self.dry_run, as_json=self.as_json)
