# mypy: disable-error-code="misc,return-value"
"""Threads that need types at the same time: the store of types is made once, and no thread sees half of a change."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from ibrobot_ros2 import codec, definitions, interfaces
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

_THREADS = 8
_SERVICES = interfaces.interfaces("srv")
_ACTIONS = interfaces.interfaces("action")
_SEPARATOR = "=" * 80
_FOREIGN = {
    f"lab_msgs/msg/Part{i}": f"float64 x\nlab_msgs/Inner{i} inner\n{_SEPARATOR}\nMSG: lab_msgs/Inner{i}\nint32 n\n"
    for i in range(6)
}


def _give_way(work: Callable[..., object]) -> Callable[..., object]:
    """As `work`, with turns of other threads before and after it, as a busy machine gives them."""

    def slower(*arguments: object, **options: object) -> object:
        time.sleep(0.0002)
        try:
            return work(*arguments, **options)
        finally:
            time.sleep(0.0002)

    return slower


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process in which no type was needed yet, and in which every change of a store takes time."""
    made = get_typestore(Stores.ROS2_JAZZY)
    monkeypatch.setattr(definitions, "get_typestore", _give_way(lambda name: _copied(made)))
    monkeypatch.setattr(Typestore, "register", _give_way(Typestore.register))
    _forget(monkeypatch)
    yield
    monkeypatch.undo()
    _forget(monkeypatch)


def _copied(made: Typestore) -> Typestore:
    store = Typestore()
    store.fielddefs, store.types = dict(made.fielddefs), dict(made.types)
    return store


def _forget(monkeypatch: pytest.MonkeyPatch) -> None:
    for made in (interfaces.service_type, interfaces.action_type):
        made.cache_clear()
    monkeypatch.setattr(definitions, "_standard", [])
    monkeypatch.setattr(codec, "_standard", codec.Codec())


def _together(works: list[Callable[[], object]]) -> list[object]:
    """The results of functions that begin at the same time, each in a thread of its own."""
    begin = threading.Barrier(len(works))

    def run(work: Callable[[], object]) -> object:
        begin.wait()
        return work()

    with ThreadPoolExecutor(len(works)) as pool:
        return [each.result() for each in [pool.submit(run, work) for work in works]]


def _all_interfaces(seed: int) -> dict[str, object]:
    """Every service and action, in an order of its own, with a request that goes there and back."""
    names = [(interfaces.service_type, name) for name in _SERVICES]
    names += [(interfaces.action_type, name) for name in _ACTIONS]
    random.Random(seed).shuffle(names)
    found = {}
    for make, name in names:
        made = found[name] = make(name)
        request = made.request if isinstance(made, interfaces.ServiceType) else made.send_goal.request
        interfaces.from_cdr(request, interfaces.to_cdr(request, {}))
    return found


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("seed", range(5))
def test_threads_define_all_interfaces_at_the_same_time(seed: int) -> None:
    results = _together([lambda n=n: _all_interfaces(seed * _THREADS + n) for n in range(_THREADS)])
    assert all(found == results[0] for found in results)


@pytest.mark.usefixtures("fresh")
def test_there_is_one_store_of_the_standard_types() -> None:
    stores = _together([definitions.standard_types] * _THREADS)
    assert len({id(each) for each in stores}) == 1


@pytest.mark.usefixtures("fresh")
def test_threads_read_the_types_of_a_bag_at_the_same_time() -> None:
    bag = codec.Codec(_FOREIGN)
    data = b"\x00\x01\x00\x00" + bytes(16)
    names = list(_FOREIGN)

    def read(n: int) -> list[type]:
        order = random.Random(n).sample(names, len(names))
        found = {name: type(bag.decode(name, data)) for name in order}
        return [found[name] for name in names]

    results = _together([lambda n=n: read(n) for n in range(_THREADS)])
    assert all(found == results[0] for found in results), "each type has one class"


def test_definition_that_replaces_another_is_never_missing() -> None:
    store = definitions.make_typestore()
    name, ended, missing = "lab_msgs/msg/Changing", threading.Event(), []
    definitions.define(store, name, "float64 x0\n")

    def look() -> None:
        while not ended.is_set():
            if name not in store.fielddefs or name not in store.types:
                missing.append(name)

    looking = threading.Thread(target=look)
    looking.start()
    for i in range(1, 40):
        definitions.define(store, name, f"float64 x{i}\n")
    ended.set()
    looking.join()
    assert not missing
    assert store.fielddefs[name][1][0][0] == "x39"
