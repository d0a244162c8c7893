"""Hostile answers of a server of LeRobot's protocol: each is refused, nothing of it runs, and memory stays bounded."""

from __future__ import annotations

import itertools
import pickle
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("grpc", reason="an extra of this package")
from ibrobot_policy_servers.lerobot_server import read_actions

from ibrobot_core.api import PolicyError

from .lerobot_server import CLASSES, Message, answered, chunk_of, named, plain, storage, tensor, timed

STAMP, NUMBER = 12.5, 7
ACTIONS = np.arange(30, dtype=np.float32).reshape(5, 6)
_NAMES = """
    os.system posix.system nt.system os.popen os.execv os.spawnl os.remove os.putenv subprocess.Popen subprocess.run
    subprocess.check_output subprocess.getoutput builtins.eval builtins.exec builtins.compile builtins.open
    builtins.getattr builtins.setattr builtins.__import__ builtins.print builtins.map builtins.type builtins.object
    builtins.bytearray __builtin__.eval operator.attrgetter operator.methodcaller operator.itemgetter functools.partial
    functools.reduce importlib.import_module imp.load_source runpy.run_path runpy.run_module code.interact pty.spawn
    pdb.run timeit.timeit cProfile.run types.FunctionType types.CodeType marshal.loads pickle.loads pickle.Unpickler
    _pickle.loads copyreg._reconstructor copyreg.__newobj__ codecs.decode _codecs.encode shutil.rmtree shutil.copy
    socket.socket ctypes.CDLL asyncio.run webbrowser.open urllib.request.urlopen http.client.HTTPConnection
    multiprocessing.Process threading.Thread sys.exit sys.settrace tempfile.mktemp logging.config.dictConfig
    numpy.load numpy.core.multiarray._reconstruct numpy._core.multiarray._reconstruct numpy.ndarray numpy.dtype
    numpy.testing._private.utils.runstring torch.load torch.hub.load torch.jit.load torch.nn.Module
    torch._utils._rebuild_parameter torch._utils._rebuild_sparse_tensor torch._utils._rebuild_tensor
    torch.storage.UntypedStorage torch.LongStorage torch.ops.load_library torch.utils.cpp_extension.load_inline
    torch.FloatStorage.__init__ collections.OrderedDict.__init__ collections.Counter collections.defaultdict
    lerobot.async_inference.helpers.TimedObservation lerobot.async_inference.helpers.RemotePolicyConfig
    lerobot.async_inference.helpers.torch.load lerobot.async_inference.helpers.os.system
    lerobot.async_inference.helpers.TimedAction.__init__.__globals__ lerobot.transport.utils.bytes_to_python_object
    ibrobot_core.api.PolicyError ibrobot_policy_servers.pickles.Made
"""


def ways(name: str, command: bytes) -> Iterator[bytes]:
    """Instructions that name and call something, in every way that pickles have."""
    module, _, last = name.rpartition(".")
    by_stack = plain(module) + plain(last) + b"\x93"
    by_memo = plain(module) + b"q\xc8" + plain(last) + b"q\xc9h\xc8h\xc9\x93"
    arguments = plain(command.decode())
    for naming in (named(name), by_stack, by_memo):
        yield naming
        yield naming + arguments + b"\x85R"
        yield naming + arguments + b"\x85\x81"
        yield naming + arguments + b"\x85}\x92"
        yield naming + b")\x81" + arguments + b"b"
        yield naming + b")R" + b"}" + plain("__setstate__") + naming + b"sb"
    yield b"(" + arguments + f"i{module}\n{last}\n".encode()
    yield b"(" + named(name) + arguments + b"o"
    yield b"\x82\x01" + arguments + b"\x85R"


def places(instructions: bytes) -> Iterator[bytes]:
    """Answers that have the instructions at each place where a pickle can have something."""
    good = tensor(storage(ACTIONS), 0, (6,), (1,))
    yield b"\x80\x04" + instructions + b"."
    yield b"\x80\x04](" + instructions + b"e."
    yield b"\x80\x04]" + instructions + b"0" + chunk_of(STAMP, NUMBER, [good])[2:]
    yield chunk_of(STAMP, NUMBER, [instructions])
    yield chunk_of(STAMP, NUMBER, [good.replace(named("torch._utils._rebuild_tensor_v2"), instructions, 1)])
    yield chunk_of(STAMP, NUMBER, [good.replace(named("torch.storage._load_from_bytes"), instructions, 1)])
    yield chunk_of(STAMP, NUMBER, [good.replace(named("collections.OrderedDict"), instructions, 1)])
    yield chunk_of(STAMP, NUMBER, [good]).replace(named(f"{CLASSES}.TimedAction"), instructions, 1)
    yield chunk_of(STAMP, NUMBER, [good]).replace(plain(NUMBER) + plain("action"), instructions + plain("action"), 1)
    head: tuple[Any, ...] = (0x1950A86A20F9469CFC6C, 1001, {})
    magic, version, about = (pickle.dumps(each, 2) for each in head)
    hidden = b"\x80\x02" + instructions + b"."
    for file in (hidden, magic + hidden, magic + version + hidden, magic + version + about + hidden):
        yield chunk_of(STAMP, NUMBER, [tensor(file, 0, (6,), (1,))])
    for old in (named("torch.FloatStorage"), plain("94"), plain("cpu")):
        file = storage(ACTIONS).replace(old, instructions, 1)
        yield chunk_of(STAMP, NUMBER, [tensor(file, 0, (6,), (1,))])


def attacks(command: bytes) -> Iterator[tuple[str, bytes]]:
    """Every name, called in every way, at every place."""
    for name in _NAMES.split():
        for instructions in ways(name, command):
            for answer in places(instructions):
                yield name, answer


def refused(answer: bytes) -> str:
    """The error; empty if the answer is read."""
    try:
        read_actions(answer, STAMP, NUMBER)
    except PolicyError as error:
        return str(error)
    return ""


def check_attacks(canary: Path, step: int) -> int:
    modules, count, named_in_error = set(sys.modules), 0, 0
    for name, answer in itertools.islice(attacks(f"touch {canary}".encode()), 0, None, step):
        error = refused(answer)
        assert error, (name, answer)
        named_in_error += name in error
        count += 1
    assert not canary.exists()
    assert set(sys.modules) == modules, "something was imported"
    assert named_in_error > count / 2, "the others fail before: they have an instruction that is not allowed"
    return count


def test_hostile_names_run_nothing(tmp_path: Path) -> None:
    """A sample of each name, way and place."""
    assert check_attacks(tmp_path / "canary", 47) > 600


@pytest.mark.long
def test_all_hostile_names_run_nothing(tmp_path: Path) -> None:
    """All of them."""
    assert check_attacks(tmp_path / "canary", 1) > 30_000


def test_the_attacks_are_real(tmp_path: Path) -> None:
    """The `pickle` module runs the command, as LeRobot's own client would."""
    canary = tmp_path / "canary"
    _, call, *_ = ways("os.system", f"touch {canary}".encode())
    for answer in itertools.islice(places(call), 2):
        pickle.loads(answer)  # noqa: S301
        assert canary.exists()
        canary.unlink()
        assert "'os.system'" in refused(answer)
        assert not canary.exists()


def good() -> bytes:
    """An answer as LeRobot sends it."""
    seen = Message()
    seen.timestamp, seen.timestep = STAMP, NUMBER
    return answered(seen, ACTIONS)


def bombs() -> Iterator[tuple[str, bytes]]:
    """Answers that are small and would need much memory, time or stack."""
    doubled = b"".join(b"q" + bytes((i,)) + b"h" + bytes((i,)) + b"\x86" for i in range(200))
    yield "tuples in tuples", b"\x80\x02)" + doubled + b"."
    keys = b"\x80\x02}(" + plain("a") + doubled + plain(1) + b"u."
    yield "a key that takes forever to hash", b"\x80\x02})" + doubled + plain(1) + b"s."
    yield "such a key among others", keys
    yield "lists in lists", b"\x80\x02" + b"](" * 300_000 + b"e" * 300_000 + b"."
    yield "tuples of one", b"\x80\x02)" + b"\x85" * 200_000 + b"."
    yield "calls of calls", b"\x80\x02" + named("collections.OrderedDict") * 9000 + b")" + b"R" * 9000 + b"."
    yield "marks", b"\x80\x02" + b"(" * 300_000 + b"t" * 300_000 + b"."
    yield "many numbers", b"\x80\x02](" + b"K\x01" * 300_000 + b"e."
    for code, size in ((b"\x8e", 8), (b"\x8d", 8), (b"B", 4), (b"X", 4), (b"\x8b", 4), (b"\x96", 8), (b"\x8a", 1)):
        for length in (255, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1):
            if length < 256**size:
                yield f"length {length} of {code!r}", b"\x80\x04" + code + length.to_bytes(size, "little") + b"ab."
    yield "a number of many digits", b"\x80\x02I" + b"9" * 5_000_000 + b"\n."
    yield "a number of many bytes", b"\x80\x02\x8b" + (4_000_000).to_bytes(4, "little") + b"\x7f" * 4_000_000 + b"."
    yield "a long name", b"\x80\x02c" + b"a" * 8_000_000 + b"\n" + b"b" * 4_000_000 + b"\n."
    yield "a name without an end", b"\x80\x02c" + b"a" * 8_000_000
    yield "a memo at a high place", b"\x80\x02]r\xff\xff\xff\xff."
    for stride, kind in itertools.product((0, 1), (np.float32, np.float64)):
        values = np.zeros(100_000, kind)
        file = storage(values, "FloatStorage" if kind is np.float32 else "DoubleStorage")
        again = [b"j\xe8\x03\0\0"] * 199
        whole = tensor(file, 0, (values.size,), (stride,)) + b"r\xe8\x03\0\0"
        yield f"actions of all values at stride {stride}, {kind}", chunk_of(STAMP, NUMBER, [whole, *again])


def more_bombs() -> Iterator[tuple[str, bytes]]:
    """Answers with as many instructions as are read."""
    yield "lists on the stack", b"\x80\x02" + b"]" * 300_000 + b"a" * 299_999 + b"."
    yield "a list in itself", b"\x80\x02]q\x00" + b"h\x00a" * 200_000 + b"."
    yield "many numbers, in parts", b"\x80\x02]" + b"K\x01a" * 300_000 + b"."
    yield "many frames", b"\x80\x04" + (b"\x95" + bytes(8)) * 300_000 + b"."
    yield "many memos", b"\x80\x04]" + b"\x94" * 300_000 + b"."
    yield "many items", b"\x80\x04}" + (plain("a") + b"K\x01s") * 200_000 + b"."


def check_bombs(answers: Iterator[tuple[str, bytes]]) -> int:
    """Each needs at most a few times what arrived, and 96 MiB for all instructions that are allowed."""
    count = 0
    for what, answer in answers:
        tracemalloc.start()
        try:
            error = refused(answer)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert error, what
        assert peak < 4 * len(answer) + (96 << 20), f"{what}: {peak >> 20} MiB for {len(answer) >> 10} KiB"
        count += 1
    return count


def test_bombs_are_refused_within_bounded_memory() -> None:
    assert check_bombs(bombs()) > 40


def test_instructions_are_counted_over_all_pickles_of_an_answer() -> None:
    """Each of the storages has few."""
    frames = b"\x80\x04" + (b"\x95" + bytes(8)) * 50_000
    files = [frames + storage(ACTIONS + i)[2:] for i in range(5)]
    assert not refused(chunk_of(STAMP, NUMBER, [tensor(file, 0, (6,), (1,)) for file in files[:3]]))
    error = refused(chunk_of(STAMP, NUMBER, [tensor(file, 0, (6,), (1,)) for file in files]))
    assert "too many instructions" in error


@pytest.mark.long
def test_more_bombs_are_refused_within_bounded_memory() -> None:
    assert check_bombs(more_bombs()) == 6


def test_a_cut_answer_is_refused_wherever_it_is_cut() -> None:
    """Each length, and what follows the end."""
    answer = good()
    np.testing.assert_array_equal(read_actions(answer, STAMP, NUMBER), ACTIONS)
    for length in range(len(answer)):
        assert refused(answer[:length]), length
    for tail in (b".", b"\0", answer, answer[:9]):
        assert refused(answer + tail) == "the answer is not a list of actions"


NUMBERS: tuple[Any, ...] = (
    0,
    1,
    2,
    5,
    6,
    29,
    30,
    31,
    -1,
    -6,
    2**31,
    2**63 - 1,
    2**63,
    -(2**63),
    2**200,
    None,
    "6",
    6.0,
    (6,),
    b"6",
)


def checked_tensors(step: int) -> tuple[int, int]:
    """Read tensors of every place, size and stride; what is read has the values that torch's view would have."""
    file, flat, read, count = storage(ACTIONS), ACTIONS.ravel(), 0, 0
    for first, size, stride in itertools.islice(itertools.product(NUMBERS, repeat=3), 0, None, step):
        answer = chunk_of(STAMP, NUMBER, [tensor(file, first, (size,), (stride,))])
        valid = all(type(each) is int and each >= 0 for each in (first, size, stride))
        inside = valid and first + max(0, size - 1) * stride < 30 and size <= 30
        count += 1
        if not inside:
            assert refused(answer), (first, size, stride)
            continue
        [actions] = read_actions(answer, STAMP, NUMBER)
        assert actions.tolist() == [flat[first + i * stride] for i in range(size)]
        read += 1
    return count, read


def test_tensors_outside_their_storage_are_refused() -> None:
    """A sample of 8,000 places, sizes and strides."""
    count, read = checked_tensors(13)
    assert count > 600
    assert 0 < read < count / 10


@pytest.mark.long
def test_all_tensors_outside_their_storage_are_refused() -> None:
    count, read = checked_tensors(1)
    assert count == 8000
    assert 0 < read < count / 10


@pytest.mark.parametrize(
    "file",
    [
        storage(ACTIONS, "LongStorage"),
        storage(ACTIONS, "DoubleStorage"),
        storage(ACTIONS, "HalfStorage"),
        storage(ACTIONS, size=29),
        storage(ACTIONS, size=31),
        storage(ACTIONS, size=-1),
        storage(ACTIONS, size=2**62),
        storage(ACTIONS, data=b"ab"),
        storage(ACTIONS).replace(b"cpu", b"gpu"),
        storage(ACTIONS).replace(plain("94"), plain("95"), 1),
        storage(ACTIONS).replace(b"\x88X", b"\x89X"),
        storage(ACTIONS).replace(plain(1001), plain(1002), 1),
        storage(ACTIONS).replace((30).to_bytes(8, "little"), (29).to_bytes(8, "little")),
        b"PK\x03\x04",
        b"",
    ],
)
def test_storages_of_another_kind_are_refused(file: bytes) -> None:
    assert refused(chunk_of(STAMP, NUMBER, [tensor(file, 0, (6,), (1,))]))


@pytest.mark.parametrize(
    "actions",
    [
        [],
        [plain(None)],
        [plain([1.0] * 6)],
        [tensor(storage(ACTIONS), 0, (5, 6), (6, 1))],
        [tensor(storage(ACTIONS), 0, (), ())],
        [tensor(storage(ACTIONS), 0, (6,), ())],
        [timed(STAMP, NUMBER, tensor(storage(ACTIONS), 0, (6,), (1,)))],
    ],
)
def test_actions_that_are_no_vectors_are_refused(actions: list[bytes]) -> None:
    assert refused(chunk_of(STAMP, NUMBER, actions))


@pytest.mark.parametrize("stamp", [None, "12.5", float("nan"), float("inf"), [STAMP], 2**300])
@pytest.mark.parametrize("number", [NUMBER, None, "7", 7.5, [NUMBER], 2**300])
def test_another_time_or_number_is_refused(stamp: Any, number: Any) -> None:
    action = tensor(storage(ACTIONS), 0, (6,), (1,))
    assert "is not the one of request 7" in refused(b"\x80\x04](" + timed(stamp, number, action) + b"e.")
