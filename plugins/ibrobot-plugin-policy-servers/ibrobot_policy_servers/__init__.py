"""The plugin's hook: policies `openpi`, `gr00t`, `vla_eval` and `lerobot_server`, models of other projects' servers."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, PolicyDescriptor, hookimpl
from ibrobot_policy_servers.options import Gr00tOptions, LerobotServerOptions, OpenpiOptions, VlaEvalOptions

_SERVED = Late("ibrobot_policy_servers.served:ServedPolicy")
_OPENPI = Late("ibrobot_policy_servers.openpi:OpenpiConnection")
_GR00T = Late("ibrobot_policy_servers.gr00t:Gr00tConnection")
_VLA_EVAL = Late("ibrobot_policy_servers.vla_eval:VlaEvalConnection")
_LEROBOT = Late("ibrobot_policy_servers.lerobot_server:LerobotConnection")


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """Policies that run on servers of other projects."""
    yield PolicyDescriptor(
        type="openpi",
        options=OpenpiOptions,
        make=lambda options, ctx: _SERVED(options, ctx, _OPENPI(options, ctx.log)),
        summary="a model of an openpi server: pi0, pi0.5, …",
    )
    yield PolicyDescriptor(
        type="gr00t",
        options=Gr00tOptions,
        make=lambda options, ctx: _SERVED(options, ctx, _GR00T(options)),
        summary="a model of a policy server of Isaac GR00T",
    )
    yield PolicyDescriptor(
        type="vla_eval",
        options=VlaEvalOptions,
        make=lambda options, ctx: _SERVED(options, ctx, _VLA_EVAL(options), stateful=True),
        summary="a model of a model server of vla-eval",
    )
    yield PolicyDescriptor(
        type="lerobot_server",
        options=LerobotServerOptions,
        make=lambda options, ctx: _SERVED(options, ctx, _LEROBOT(options)),
        summary="a model of LeRobot's policy server",
    )
