"""A port for Prometheus and for probes of health and readiness."""

from ibrobot_monitoring.probes import Probes, ProbeServer

__all__ = ["ProbeServer", "Probes"]
