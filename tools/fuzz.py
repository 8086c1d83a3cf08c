"""Throw files that are almost right at every reader: each must be read, or refused by the errors
that are documented.

    python tools/fuzz.py --inputs 200000 --seconds 600 --readers ply obj    # all readers if none is
    named

Two kinds of inputs take turns: mutations of real files, by a fixed seed, and inputs that grow from
those which reached lines of `splatjax.io` that none had reached before (coverage-guided, by atheris
where it is installed). Memory is limited, warnings of NumPy count as errors, and so does whatever
computes longer than five seconds. What is found is written to tests/io/corpus, where
tests/io/test_corpus.py reads it ever after.
"""

import argparse
import hashlib
import multiprocessing
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

from fuzz_doors import DOORS, Door

CORPUS = Path(__file__).parents[1] / "tests" / "io" / "corpus"
LONGEST = 5  # seconds
MEMORY = 4 << 30  # bytes of address space, most of it taken by libraries
SEED = 20_250_101


class TooLongError(BaseException):
    """A reader took longer than it may."""


def _ring(*_) -> None:
    raise TooLongError("took too long")


def try_input(door: Door, path: Path, longest: float = LONGEST) -> str:
    """Read a file; say what became of it: `read`, `refused`, or the traceback of what should not
    have happened.
    """
    before = signal.signal(signal.SIGPROF, _ring)
    signal.setitimer(signal.ITIMER_PROF, longest)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)
            door.read(path)
        return "read"
    except (ValueError, OSError) as error:
        said = str(error)
        if "\n" in said or str(path.parent) not in said:
            return f"says no file, or more than a line: {said[:300]!r}\n{traceback.format_exc()}"
        return "refused"
    except BaseException:
        return traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


_NUMBERS = [
    b"0",
    b"-1",
    b"1",
    b"255",
    b"256",
    b"65536",
    b"2147483647",
    b"4294967296",
    b"9223372036854775808",
    b"1e308",
    b"-1e-320",
]
_WORDS = [
    *_NUMBERS,
    b"nan",
    b"inf",
    b"-inf",
    b"1e999",
    b'""',
    b"null",
    b"true",
    b"[]",
    b"{}",
    b"\xff\xfe",
    b"\0",
    b"..",
    b"0.5",
    b"1_0",
]
_FLOATS = [float("nan"), float("inf"), 1e38, -1.0]
_TOKEN = re.compile(rb"[A-Za-z_]+|-?[0-9.]+(?:e[-+]?[0-9]+)?|\s+|[^\sA-Za-z0-9_]")
_INTEGERS = [0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]


def mutate(data: bytes, others: list[bytes], chance: random.Random) -> bytes:
    """Spoil a file in one place or in a few: bytes, numbers, words, pieces lost, doubled or taken
    from another file.
    """
    for _ in range(chance.choice((1, 1, 1, 2, 3, 6))):
        if not data:
            return chance.choice(others)
        at = chance.randrange(len(data))
        match chance.randrange(9):
            case 0:
                data = data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]
            case 1:
                data = data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]
            case 2:
                data = data[:at]
            case 3:
                data = data[:at] + data[at + chance.randrange(1, 20) :]
            case 4:
                data = (
                    data[:at]
                    + data[max(0, at - chance.randrange(1, 40)) : at] * chance.randrange(1, 4)
                    + data[at:]
                )
            case 5:
                kind = chance.choice(("<I", ">I", "<H", "<Q", "<f", "<d"))
                value = (
                    chance.choice((float("nan"), float("inf"), 1e38, -1.0))
                    if kind in ("<f", "<d")
                    else chance.choice(_INTEGERS)
                )
                packed = struct.pack(kind, min(value, 0xFFFF) if kind == "<H" else value)
                data = data[:at] + packed + data[at + len(packed) :]
            case 6:
                other = chance.choice(others)
                data = (
                    data[:at]
                    + other[chance.randrange(len(other)) :][: chance.randrange(1, 200)]
                    + data[at:]
                )
            case _:
                tokens = list(_TOKEN.finditer(data[: 1 << 14]))
                if tokens:
                    token = chance.choice(tokens)
                    word = chance.choice((*_WORDS, chance.choice(tokens)[0]))
                    data = data[: token.start()] + word + data[token.end() :]
    return data


def _work(name: str, folder: Path, inputs: int, seconds: float, counts, guided: bool) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    door = DOORS[name]
    paths = door.seeds(folder)
    for each in paths:  # libraries are imported when they are first needed
        try_input(door, each, 100 * LONGEST)
    seeds = [each.read_bytes() for each in paths]
    path = folder / f"input{door.suffix}"
    chance = random.Random(f"{SEED} {name} {counts[0]} {guided}")
    begin = time.monotonic()

    def one(data: bytes) -> None:
        path.write_bytes(data)
        became = try_input(door, path)
        counts[0] += 1
        counts[1] += became == "read"
        if became not in ("read", "refused"):
            counts[2] += 1
            keep(name, data, became)

    for data in seeds:
        one(data)
    if guided:
        _guided(one, seeds, inputs, seconds, folder)
        return
    while counts[0] < inputs and time.monotonic() - begin < seconds:
        one(mutate(chance.choice(seeds), seeds, chance))


def _guided(
    one: Callable[[bytes], None], seeds: list[bytes], inputs: int, seconds: float, folder: Path
) -> None:
    import atheris

    corpus = folder / "grown"
    corpus.mkdir(exist_ok=True)
    for i, data in enumerate(seeds):
        (corpus / str(i)).write_bytes(data)
    modules = [module for name, module in sys.modules.items() if name.startswith("splatjax.io.")]
    for module in modules:
        own = [
            value
            for value in vars(module).values()
            if getattr(value, "__module__", "") == module.__name__
        ]
        for value in own + [
            method for each in own if isinstance(each, type) for method in vars(each).values()
        ]:
            if hasattr(value, "__code__"):
                value.__code__ = atheris.instrument_func(value).__code__
    options = [
        f"-runs={inputs}",
        f"-max_total_time={int(seconds)}",
        "-max_len=8192",
        f"-seed={SEED}",
        "-print_final_stats=0",
    ]
    atheris.Setup(
        [
            sys.argv[0],
            *options,
            "-verbosity=0",
            "-rss_limit_mb=0",
            "-timeout=100",
            "-handle_segv=0",
            str(corpus),
        ],
        one,
    )
    atheris.Fuzz()


def keep(name: str, data: bytes, became: str) -> None:
    """Write an input that was not taken as it should be, once for each place in the code where it
    failed.
    """
    places = re.findall(r'File "[^"]*/([^"/]+)", line (\d+)', became)
    last = became.strip().splitlines()[-1][:100]
    digest = hashlib.sha256(
        f"{places[-2:]} {re.sub(r'[0-9]+', '', last)[:40]}".encode()
    ).hexdigest()[:10]
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{digest}{DOORS[name].suffix}"
    if not path.exists():
        path.write_bytes(data)
        print(f"{name}: {path.name}: {last}", file=sys.stderr, flush=True)


def fuzz(name: str, inputs: int, seconds: float, *, guided: bool) -> None:
    """Throw inputs at a reader in processes of their own, one after the other where one dies."""
    counts = multiprocessing.Array("q", 3, lock=False)
    begin, deaths = time.monotonic(), 0
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as made:
        folder = Path(made)
        while counts[0] < inputs and (left := seconds - (time.monotonic() - begin)) > 1:
            process = multiprocessing.get_context("fork").Process(
                target=_work, args=(name, folder, inputs, left, counts, guided)
            )
            process.start()
            process.join(2 * left + 60)
            if process.is_alive():
                process.kill()
                process.join()
            elif process.exitcode == 0:
                break
            deaths += 1
            path = folder / f"input{DOORS[name].suffix}"
            keep(
                name,
                path.read_bytes(),
                f"the process died: {process.exitcode}, "
                f"{hashlib.sha256(path.read_bytes()).hexdigest()}",
            )
    spent = time.monotonic() - begin
    kind = "grown" if guided else "mutations"
    print(
        f"{name}: {counts[0]} {kind}, {counts[1]} read, {counts[0] - counts[1] - counts[2]} "
        f"refused, {counts[2]} wrong,"
        f" {deaths} deaths, {spent:.0f} s, {counts[0] / spent:.0f} per s",
        flush=True,
    )


def main() -> None:
    """Fuzz the readers that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=200_000, help="of each kind, for each reader")
    parser.add_argument(
        "--seconds", type=float, default=600.0, help="at most, for each kind and reader"
    )
    parser.add_argument("--readers", nargs="+", choices=DOORS, default=list(DOORS))
    parser.add_argument(
        "--kinds", nargs="+", choices=("mutations", "grown"), default=("mutations", "grown")
    )
    options = parser.parse_args()
    import splatjax.io  # noqa: F401  Before processes are forked.

    for name in options.readers:
        for kind in options.kinds:
            if kind == "grown" and not _atheris_there():
                print(f"{name}: atheris is not installed, so that no inputs were grown", flush=True)
                continue
            fuzz(name, options.inputs, options.seconds, guided=kind == "grown")


def _atheris_there() -> bool:
    import importlib.util

    return importlib.util.find_spec("atheris") is not None


if __name__ == "__main__":
    main()
