"""Do the tests notice? Small mistakes are planted in the mathematics, one at a time: `python
tools/mutate.py --sample 400`.

A seeded sample of all places where an operator, a comparison, a number or a function's name can be
mistaken for its neighbor is taken from `gaussians`, `scattering`, `fitting`, `splatting` and
`diffusion`. Each mutant meets the tests of its room, as long as there is time: first those that run
through its line (by coverage.py's contexts, the shortest first), then those beside them, which
share what the first has compiled or drawn. In double precision, and if it lives those that run once
in single precision too. What lives on is written out with its line. Needs coverage.py
(`.venv/bin/uv pip install coverage`). Results are kept in a folder, and the same command goes on
where it stopped; `--again` meets what has lived anew, with a larger `--budget` or other tests.
"""

import argparse
import ast
import json
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple

from mutate_meet import Meeting, in_child, pytest_in

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("gaussians", "scattering", "fitting", "splatting", "diffusion")
LEAST = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1"
)
PATIENCE = 40.0, 3.0
"""Seconds of processor time that a mutant may take more than its tests, and how many times theirs.
"""
LONGEST = 90.0
"""Seconds of processor time of a test that there is no time for."""
PRECISIONS = {True: "not once and not long", False: "once and not long"}
"""Whether double, and which tests."""
_SEVERAL = "tests/render/test_devices.py"
BESIDE = {
    "scattering": ("tests/transport/test_single_scattering.py", "tests/render/test_laser_dot.py"),
    "fitting": ("tests/render/test_laser_dot.py",),
    "splatting": (_SEVERAL, "tests/render/test_streamed.py"),
    "diffusion": (
        _SEVERAL,
        "tests/render/test_streamed.py",
        "tests/render/test_gathered.py",
        "tests/gradients/test_jacobian.py",
    ),
}
"""Tests of a room's parts that stand in other folders, since they need more than the room."""
LIVING = ("lives", "no test")
UNSEEN = {"_sharded.py": _SEVERAL}
"""Files that run in other processes, where coverage does not look, and their tests."""
_BINARY = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.Pow: "*",
    ast.FloorDiv: "/",
    ast.Mod: "*",
    ast.MatMult: "*",
}
_COMPARE = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
}
_NAMES = {
    "minimum": "maximum",
    "min": "max",
    "floor": "ceil",
    "sin": "cos",
    "any": "all",
    "argmin": "argmax",
    "sum": "max",
    "exp": "expm1",
}
_NAMES |= {
    "log": "log1p",
    "sqrt": "square",
    "zeros": "ones",
    "zeros_like": "ones_like",
    "cumsum": "cumprod",
    "abs": "negative",
}
_NAMES |= {
    other: name
    for name, other in _NAMES.items()
    if name not in ("sum", "log", "exp", "abs", "sqrt", "cumsum")
}


class Mutant(NamedTuple):
    """A place in a file (line and columns, from 1 and 0) where another text is to stand."""

    path: str
    line: int
    start: int
    end: int
    text: str

    def name(self) -> str:
        """Give what tells it from all others."""
        return f"{self.path}:{self.line}:{self.start} -> {self.text}"


def mutants_of(path: Path) -> list[Mutant]:
    """Find all that can be planted in a file: nothing in annotations, nor in what is raised."""
    source = path.read_text()
    lines = source.splitlines()
    found = []

    def between(left: ast.expr, right: ast.expr, text: str) -> None:
        if (
            left.end_lineno == right.lineno
        ):  # the operator stands between, perhaps among parentheses
            gap = lines[right.lineno - 1].encode()[left.end_col_offset : right.col_offset].decode()
            operator = gap.strip().strip("()").strip()
            at = left.end_col_offset + gap.index(operator)
            found.append(
                Mutant(str(path.relative_to(ROOT)), right.lineno, at, at + len(operator), text)
            )

    def instead(node: ast.expr, text: str) -> None:
        if node.lineno == node.end_lineno:
            found.append(
                Mutant(
                    str(path.relative_to(ROOT)),
                    node.lineno,
                    node.col_offset,
                    node.end_col_offset or 0,
                    text,
                )
            )

    def visit(node: ast.AST) -> None:
        match node:
            case ast.Raise() | ast.Import() | ast.ImportFrom() | ast.Assert():
                return
            case ast.BinOp() if type(node.op) in _BINARY:
                between(node.left, node.right, _BINARY[type(node.op)])
            case ast.Compare(ops=[op]) if type(op) in _COMPARE:
                between(node.left, node.comparators[0], _COMPARE[type(op)])
            case ast.BoolOp():
                between(*node.values[:2], "or" if isinstance(node.op, ast.And) else "and")
            case ast.UnaryOp(op=ast.USub() | ast.Not()) if not isinstance(
                node.operand, ast.Constant
            ):
                instead(node, f"({ast.unparse(node.operand)})")
            case ast.Constant(value=bool()):
                instead(node, str(not node.value))
            case ast.Constant(value=int()):
                instead(node, str(node.value + 1))
            case ast.Constant(value=float()):
                instead(node, repr(node.value * 1.5 or 1.0))
            case ast.Attribute() if node.attr in _NAMES and node.end_lineno == node.lineno:
                end = node.end_col_offset or 0
                found.append(
                    Mutant(
                        str(path.relative_to(ROOT)),
                        node.lineno,
                        end - len(node.attr.encode()),
                        end,
                        _NAMES[node.attr],
                    )
                )
            case ast.IfExp():
                instead(node.test, f"(not ({ast.unparse(node.test)}))")
        for name, child in ast.iter_fields(node):
            if name not in ("annotation", "returns"):
                for each in child if isinstance(child, list) else [child]:
                    if isinstance(each, ast.AST):
                        visit(each)

    visit(ast.parse(source))
    return sorted(set(found))


def sampled(count: int, seed: int) -> list[Mutant]:
    """Take a sample of all mutants of the rooms."""
    paths = [
        path
        for room in ROOMS
        for path in sorted(ROOT.glob(f"splatjax/{room}.py"))
        + sorted(ROOT.glob(f"splatjax/{room}/*.py"))
    ]
    everyone = [mutant for path in paths for mutant in mutants_of(path)]
    print(f"{len(everyone)} mutants in {len(paths)} files")
    return random.Random(seed).sample(everyone, min(count, len(everyone)))


def room_tests(room: str) -> list[str]:
    """Give where the tests of a room stand."""
    own = (ROOT / "tests" / room, ROOT / "tests" / f"test_{room}.py")
    return [*(str(path.relative_to(ROOT)) for path in own if path.exists()), *BESIDE.get(room, ())]


class Recorder:
    """A pytest plugin that tells coverage which test is running, keeps how long each took, and ends
    those that take too long.
    """

    def __init__(self, measured):
        self.measured, self.seconds, self.failed = measured, {}, set()

    def pytest_runtest_logstart(self, nodeid, location):
        """Let what runs from here on count for this test."""
        self.measured.switch_context(nodeid)
        signal.signal(signal.SIGPROF, _enough)
        signal.setitimer(signal.ITIMER_PROF, LONGEST)

    def pytest_runtest_logreport(self, report):
        """Add what a part of a test took; a test that fails without mutants tells nothing."""
        if report.failed:
            self.failed.add(report.nodeid)
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.when == "teardown":
            signal.setitimer(signal.ITIMER_PROF, 0)


def _enough(*_) -> None:
    raise TimeoutError(f"more than {LONGEST} seconds")


def measure(folder: Path, copy: Path, double: bool) -> None:
    """Run the tests of all rooms once, and keep which of them run through which line, and how long
    they take.
    """
    import coverage

    def work() -> int:
        measured = coverage.Coverage(
            data_file=str(folder / f"coverage-{double}"),
            source=[str(copy / "splatjax")],
            branch=False,
        )
        recorder = Recorder(measured)
        measured.start()
        tests = sorted({test for room in ROOMS for test in room_tests(room)})
        status = pytest_in(copy, double, [*tests, "-m", PRECISIONS[double]], [recorder])
        measured.stop()
        measured.save()
        (folder / f"seconds-{double}.json").write_text(
            json.dumps(
                {
                    test: took
                    for test, took in recorder.seconds.items()
                    if test not in recorder.failed
                }
            )
        )
        return status

    if not (folder / f"seconds-{double}.json").exists():
        status, seconds = in_child(folder / f"log-{double}", work)
        print(
            f"tests of all rooms, {'double' if double else 'single'} precision: status {status}, "
            f"{seconds:.0f} s",
            flush=True,
        )


def lines_to_tests(
    folder: Path, copy: Path, double: bool
) -> tuple[dict[tuple[str, int], set[str]], dict[str, float]]:
    """Give the tests that run through each line, and their seconds."""
    import coverage

    data = coverage.CoverageData(str(folder / f"coverage-{double}"))
    data.read()
    found = {}
    for path in data.measured_files():
        for line, tests in data.contexts_by_lineno(path).items():
            found[str(Path(path).relative_to(copy)), line] = {test for test in tests if test}
    return found, json.loads((folder / f"seconds-{double}.json").read_text())


def chosen(mutant: Mutant, lines, seconds: dict[str, float], budget: float) -> list[str]:
    """Give the tests of its room that may notice a mutant, as long as there is time for them.

    Those that run through its line come first, the shortest of them before all. Only the first test
    that needs something compiled or drawn runs through its lines: next are those of the same files,
    and then those that run through the mutant's file at all.
    """
    places = tuple(room_tests(Path(mutant.path).parts[1].removesuffix(".py")))
    unseen = UNSEEN.get(Path(mutant.path).name)
    through = {test for test in seconds if unseen and test.startswith(unseen)} | lines.get(
        (mutant.path, mutant.line), set()
    )
    files = {test.split("::")[0] for test in through}
    of_file = {test for (path, _), those in lines.items() if path == mutant.path for test in those}

    def order(test: str) -> tuple[bool, bool, float]:
        return test not in through, test.split("::")[0] not in files, seconds[test]

    candidates = {test for test in seconds if test.split("::")[0] in files} | of_file | through
    taken, sum_ = [], 0.0
    for test in sorted(
        (test for test in candidates if test in seconds and test.startswith(places)), key=order
    ):
        sum_ += seconds[test]
        if taken and sum_ > budget:
            break
        taken.append(test)
    return taken


def planted(mutant: Mutant, text: bytes) -> bytes:
    """Give the text of a file with a mutant in it."""
    lines = text.splitlines(keepends=True)
    line = lines[mutant.line - 1]
    lines[mutant.line - 1] = line[: mutant.start] + mutant.text.encode() + line[mutant.end :]
    return b"".join(lines)


def meet(
    mutant: Mutant, copy: Path, meeting: Meeting, tests: list[str], seconds: float
) -> tuple[str, float]:
    """Let tests meet a mutant."""
    more, times = PATIENCE
    target = copy / mutant.path
    before, limit = target.read_bytes(), more + times * seconds
    text = planted(mutant, before)
    fate, took = meeting.meet(mutant.path, text, tests, limit)
    if fate != "imported":
        return fate, took
    target.write_bytes(text)
    try:
        status, more = in_child(
            copy.parent / "log", lambda: pytest_in(copy, meeting.double, ["-x", *tests]), limit
        )
    finally:
        target.write_bytes(before)
    if status in (-24, -9):
        return "too slow", took + more
    if status > 2 and status != 5:  # 2: it cannot be imported
        raise RuntimeError(f"pytest ended with status {status}; {copy.parent / 'log'} says why")
    return ("lives" if status in (0, 5) else "killed"), took + more


def main() -> None:
    """Measure, plant, meet, report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "mutants")
    parser.add_argument(
        "--budget",
        type=float,
        default=30.0,
        help="seconds of tests for a mutant, in each precision",
    )
    parser.add_argument("--minutes", type=float, default=1e9, help="stop then")
    parser.add_argument("--again", action="store_true", help="meet again what has lived")
    given = parser.parse_args()
    os.environ["XLA_FLAGS"] = LEAST
    # noqa: E401, F401, I001
    import beartype, equinox, jax, matplotlib, optimistix, pytest, scipy.optimize, scipy.spatial

    folder, copy = given.folder.resolve(), given.folder.resolve() / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    for name in ("splatjax", "tests", "profiles", "benchmarks"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.pyc"))
    shutil.copy2(ROOT / "pyproject.toml", copy)
    for double in PRECISIONS:
        measure(folder, copy, double)
    sys.dont_write_bytecode = True  # from here on what is cached is the project's own
    meetings = {double: Meeting(copy, double) for double in PRECISIONS}
    tables = {double: lines_to_tests(folder, copy, double) for double in PRECISIONS}
    record = folder / "met.jsonl"
    met = (
        {each["name"]: each for each in map(json.loads, record.read_text().splitlines())}
        if record.exists()
        else {}
    )
    began = time.time()
    for number, mutant in enumerate(sampled(given.sample, given.seed)):
        if mutant.name() in met and not (given.again and met[mutant.name()]["fate"] in LIVING):
            continue
        if time.time() - began > 60 * given.minutes:
            break
        fate, took, tests = "no test", 0.0, []
        for double, (lines, seconds) in tables.items():
            tests = chosen(mutant, lines, seconds, given.budget)
            if tests:
                fate, spent = meet(
                    mutant, copy, meetings[double], tests, sum(seconds[test] for test in tests)
                )
                took += spent
            if fate not in LIVING:
                break
        met[mutant.name()] = {
            "name": mutant.name(),
            "fate": fate,
            "seconds": round(took, 1),
            "tests": len(tests),
        }
        with record.open("a") as file:
            print(json.dumps(met[mutant.name()]), file=file)
        print(f"{number + 1}: {fate} after {took:.0f} s, {mutant.name()}", flush=True)
    for meeting in meetings.values():
        meeting.end()
    _report(list(met.values()))


def _report(met: list[dict]) -> None:
    for fate in ("killed", "too slow", "lives", "no test"):
        print(f"{fate}: {sum(each['fate'] == fate for each in met)} of {len(met)}")
    for each in met:
        if each["fate"] in LIVING:
            path, line = each["name"].split(":")[:2]
            print(
                f"{each['fate']}: {each['name']}\n    "
                f"{(ROOT / path).read_text().splitlines()[int(line) - 1].strip()}"
            )


if __name__ == "__main__":
    main()
