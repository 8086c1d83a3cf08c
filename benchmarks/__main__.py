"""How fast a frame and its derivatives are, beside the yardstick: `python -m benchmarks`. Writes
out/bench.json.

Every body and size runs in a process of its own (`python -m benchmarks.frame`).
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

# Body, splats, width, and whether the frame alone is timed.
CASES = [
    ("synthetic", 10_000, 512, False),
    ("synthetic", 100_000, 512, False),
    ("synthetic", 683_549, 1024, False),
    ("scanned", 683_549, 1024, False),
    ("synthetic", 100_000, 1024, True),
    ("synthetic", 683_549, 2048, True),
    ("synthetic", 10_000_000, 2048, True),
]
# In yardsticks of that body and size.
GOALS = {
    ("passes 2+3", 683_549, 1024): 1.0,
    ("passes 2+3 with gradients", 683_549, 1024): 3.0,
    ("all five passes", 683_549, 1024): 5.0,
    ("all five passes with gradients", 683_549, 1024): 14.0,
    ("all five passes", 100_000, 512): 6.0,
}
_HEADINGS = ("ms", "ratio", "goal", "compile, s", "memory, GB")


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--repeats", type=int, default=7, help="rounds; medians are given (default %(default)s)"
    )
    parser.add_argument(
        "--largest", type=int, default=10_000_000, help="of splats; cases with more are left out"
    )
    return parser.parse_args()


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def report(rows: list[dict]) -> None:
    """Print the rows of one body and size."""
    first = rows[0]
    yard, limit, both = (
        first[f"{name}_milliseconds"] for name in ("yardstick", "limit", "limit_with_gradients")
    )
    print(f"\n{first['splats']:,} splats of the {first['body']} head at {first['width']}^2")
    print(
        f"passes 2+3 in C, one thread: {_number(yard, 1) or 'none'} ms, the unit; hand-tuned "
        f"{_number(limit, 1) or 'none'}",
        end="",
    )
    print(f", with gradients {_number(both, 1) or 'none'}")
    print(
        f"planning {first['planning_milliseconds']:.0f} ms; greatest memory of the process "
        f"{first['process_gigabytes']:.1f} GB"
    )
    print(f"{'':50}" + "".join(f"{heading:>12}" for heading in _HEADINGS))
    by_name = {row["name"]: row["milliseconds"] for row in rows}
    for row in rows:
        numbers = _number(row["milliseconds"], 1), _number(row["ratio"]), _number(row["goal"], 1)
        costs = _number(row["compile_seconds"], 1), _number(row["gigabytes"])
        print(f"{row['name']:50}" + "".join(f"{number:>12}" for number in (*numbers, *costs)))
    frame = by_name["all five passes"]
    for name in [name for name in by_name if name.startswith("all five passes with")]:
        print(f"{name}, over a frame: {by_name[name] / frame:.2f}")
    print(f"a frame: {1e6 * frame / first['splats']:.0f} ns per splat", flush=True)


def main() -> None:
    options = arguments()
    rows = []
    for body, splats, width, frame_only in CASES:
        if splats > options.largest:
            continue
        command = [
            sys.executable,
            "-m",
            "benchmarks.frame",
            "--body",
            body,
            "--splats",
            str(splats),
            "--width",
            str(width),
        ]
        command += ["--repeats", str(options.repeats), *(["--frame-only"] if frame_only else [])]
        *lines, last = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, check=True
        ).stdout.splitlines()
        print("\n".join(lines), end="\n" if lines else "")
        found = [
            row | {"goal": GOALS.get((row["name"], splats, width))} for row in json.loads(last)
        ]
        report(found)
        rows += found
    out = Path("out/bench.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
