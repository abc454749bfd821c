"""What benchmarks share: timing in turns, compile times, the machine, the report."""

import argparse
import importlib.metadata
import os
import pathlib
import platform
import re
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """The compiled program and the milliseconds its tracing and compilation took."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, (time.perf_counter() - start) * 1e3


def timed(
    cases: dict[str, Callable[[], Any]], repeats: int = 15
) -> dict[str, tuple[float, float, Any]]:
    """Minimum and median in milliseconds, and the answer; the cases take turns."""
    answers = {name: jax.block_until_ready(case()) for name, case in cases.items()}
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(repeats):
        for name, case in cases.items():
            start = time.perf_counter()
            jax.block_until_ready(case())
            times[name].append((time.perf_counter() - start) * 1e3)
    return {n: (min(t), float(np.median(t)), answers[n]) for n, t in times.items()}


def machine(packages: Sequence[str]) -> str:
    """Processor, cores, versions; no names of hosts."""
    model = platform.processor() or platform.machine()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        model = next(
            (x.split(":")[1].strip() for x in lines if "model name" in x), model
        )
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in packages)
    where = f"{model}, {os.cpu_count()} cores, {jax.default_backend()}"
    return f"{where}; Python {platform.python_version()}, {versions}"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A markdown table; numbers to three figures, None left empty."""

    def shown(value: Any) -> str:
        if value is None:
            return ""
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    lines += ["| " + " | ".join(shown(v) for v in row) + " |" for row in rows]
    return "\n".join(lines)


def arguments(description: str | None) -> argparse.ArgumentParser:
    """A parser that knows --write."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--write", action="store_true", help="store the table in results/"
    )
    return parser


def report(
    name: str,
    title: str,
    text: str,
    packages: Sequence[str],
    write: bool,
    options: str = "",
) -> None:
    """Print the machine and the table, and store them beside the code if asked to.

    With options of the command line, the name of the file has the last word of them.
    """
    print(machine(packages), text, sep="\n\n")
    if write:
        last = [x.lstrip("-") for x in options.split()[-1:]]
        file = "-".join([name, *last])
        path = pathlib.Path(__file__).parent / "results" / f"{file}.md"
        path.parent.mkdir(exist_ok=True)
        script = f"benchmarks/bench_{name}.py"
        command = " ".join(["python", script, *options.split(), "--write"])
        where = machine(packages)
        path.write_text(f"# {title}\n\n`{command}` on {where}.\n\n{text}\n")


def report_by_jax(
    name: str, title: str, text: str, packages: Sequence[str], write: bool
) -> None:
    """As `report`, with one section of the file for each version of jax."""
    print(machine(packages), text, sep="\n\n")
    if not write:
        return
    path = pathlib.Path(__file__).parent / "results" / f"{name}.md"
    path.parent.mkdir(exist_ok=True)
    old = path.read_text() if path.exists() else ""
    parts = re.split(r"^## (jax \S+)\n", old, flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    own = f"jax {jax.__version__}"
    sections[own] = f"\nOn {machine(packages)}.\n\n{text}\n\n"
    command = f"`python benchmarks/bench_{name}.py --write`"
    body = "".join(f"## {x}\n{sections[x]}" for x in sorted(sections))
    path.write_text(f"# {title}\n\n{command}.\n\n{body.rstrip()}\n")
