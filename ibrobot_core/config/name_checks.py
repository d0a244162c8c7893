"""Checks of names that options give: topics that two components would publish, and peripherals that do not exist."""

from __future__ import annotations

from ibrobot_core.config.structure import ParsedSections
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.messages import RUN_TOPICS
from ibrobot_core.schema import ContractConfig


def check_names(document: Document, sections: ParsedSections) -> None:
    """Add a fault for each topic that something else publishes, and for each unknown peripheral."""
    publishers = _publishers(sections)
    peripherals = [str(item.get("name")) for _, item in document.items("peripherals")]
    for part in (*sections.active(), *sections.teleoperation.values()):
        for option, topic in part.component.options.publishes():
            if topic in publishers:
                document.add((*part.key, *option), f"{topic} is published by {publishers[topic]} already")
            publishers.setdefault(topic, document.dotted(part.key))
        for option, name in part.component.options.peripherals():
            document.refer((*part.key, *option), name, peripherals, "peripheral")


def _publishers(sections: ParsedSections) -> dict[str, str]:
    """Topic -> what publishes it, whatever the options of plugins say."""
    contract: ContractConfig | None = sections.plain.get("contract")
    publishers = dict.fromkeys(RUN_TOPICS, "every run")
    publishers |= {spec.topic: "the actions of the contract" for spec in (contract.actions if contract else ())}
    for name, part in sections.peripherals.items():
        if topic := part.component.published:
            publishers[topic] = f"peripheral {name}"
    return publishers
