"""The plugin's hook: policies `openpi`, `gr00t` and `vla_eval`, models of servers of other projects."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import PolicyDescriptor, hookimpl
from ibrobot_policy_servers.options import Gr00tOptions, OpenpiOptions, VlaEvalOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Context, Policy


def _openpi(options: Any, ctx: Context) -> Policy:
    from ibrobot_policy_servers.openpi import OpenpiConnection
    from ibrobot_policy_servers.served import ServedPolicy

    return ServedPolicy(options, ctx, OpenpiConnection(options, ctx.log))


def _gr00t(options: Any, ctx: Context) -> Policy:
    from ibrobot_policy_servers.gr00t import Gr00tConnection
    from ibrobot_policy_servers.served import ServedPolicy

    return ServedPolicy(options, ctx, Gr00tConnection(options))


def _vla_eval(options: Any, ctx: Context) -> Policy:
    from ibrobot_policy_servers.served import ServedPolicy
    from ibrobot_policy_servers.vla_eval import VlaEvalConnection

    return ServedPolicy(options, ctx, VlaEvalConnection(options), stateful=True)


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """Policies that run on servers of other projects."""
    yield PolicyDescriptor(
        type="openpi", options=OpenpiOptions, make=_openpi, summary="a model of an openpi server: pi0, pi0.5, …"
    )
    yield PolicyDescriptor(
        type="gr00t", options=Gr00tOptions, make=_gr00t, summary="a model of a policy server of Isaac GR00T"
    )
    yield PolicyDescriptor(
        type="vla_eval", options=VlaEvalOptions, make=_vla_eval, summary="a model of a model server of vla-eval"
    )
