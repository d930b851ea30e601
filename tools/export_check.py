"""Proof of exported laws: strict compilers, sanitizers, other processors, ranges of all numbers, and sizes.

Whatever tool this machine lacks is named and left out; nothing is installed.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import nbs_pin as nbs
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.export.reals import LIBM

HERE = Path(__file__).parent / "export"
STRICT = (
    "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow",
    "-Wstrict-prototypes", "-Werror",
)  # fmt: skip
CALLED = {f"{name}{kind}" for name in ("sincos", *LIBM) for kind in ("", "f")}
"""sincos is what gcc makes of a sine and a cosine of one angle."""
MOST_STACK, MOST_BYTES = 16 * 1024, 192 * 1024
RANGES = {"q": 7.0, "v": 10.0, "q_ref": 7.0, "v_ref": 10.0, "a_ref": 100.0, "last": 1000.0}
"""Sizes of what a step is given, for which no operation may overflow or divide by 0 [rad, rad/s, rad/s², N·m]."""
SANITIZED = "ASan and UBSan"
FLAGS = {
    "-O0": ["-O0"],
    "-O3": ["-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast"],
    SANITIZED: ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"],
}
AARCH64_GCC, M7_GCC = "aarch64-linux-gnu-gcc", "arm-none-eabi-gcc"
M7 = ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb", "--specs=rdimon.specs")
EVA = """#include "{name}.h"
#include "__fc_builtin.h"
int main(void)
{{
    {name}_state state;
    {name}_real q[{n}], v[{n}], q_ref[{n}], v_ref[{n}], a_ref[{n}], tau[{n}], last[{n}];
    for (int i = 0; i < {n}; i++) {{
{ranges}
    }}
    {name}_start(&state, last);
    return (int){name}_step(&state, q, v, q_ref, v_ref, a_ref, 0.001, tau);
}}
"""


class Failed(Exception):
    """What was promised does not hold; the text says what."""


@cache
def is_here(program: str) -> bool:
    """Whether this machine has a program, or the sanitizers of a compiler."""
    compiler, _, sanitizers = program.partition("'s ")
    if not sanitizers or shutil.which(compiler) is None:
        return shutil.which(program) is not None
    with tempfile.TemporaryDirectory() as made:
        source = Path(made) / "nothing.c"
        source.write_text("int main(void) { return 0; }\n")
        command = [compiler, *FLAGS[SANITIZED], source, "-o", f"{made}/nothing"]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


def self_test(
    folder: Path, compiler: str, flags: list[str], run: tuple[str, ...] = (), more: tuple[str, ...] = ()
) -> str:
    """Compile a law with its self-test, every warning an error, and run it; what it prints."""
    with tempfile.TemporaryDirectory() as made:
        sources = [folder / "selftest.c", _source(folder)]
        _call(compiler, *STRICT, *flags, *more, *sources, "-lm", "-o", f"{made}/selftest")
        return _call(*run, f"{made}/selftest")


def symbols(folder: Path) -> str:
    """The functions of libm that a law calls; raises Failed if it has a variable or calls anything else."""
    called = []
    with tempfile.TemporaryDirectory() as made:
        _call("gcc", *STRICT, "-O2", "-c", _source(folder), "-o", f"{made}/law.o")
        for line in _call("nm", f"{made}/law.o").splitlines():
            kind, name = line.split()[-2:]
            if kind in "BbDdCc" or (kind == "U" and name not in CALLED):
                raise Failed(f"{folder.name} has the symbol {name} ({kind})")
            called += [name] if kind == "U" else []
    return f"it calls {', '.join(called) or 'nothing'}"


def middleware(folder: Path, source: str, headers: dict[str, str], driver: str | None) -> str:
    """Compile a C++ source of the package against imitated headers, run it or a driver that includes it; its output."""
    law = _source(folder)
    with tempfile.TemporaryDirectory() as made:
        for name, text in headers.items():
            (Path(made) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(made) / name).write_text(text)
        main = folder / source
        if driver is not None:
            main = Path(made) / "driver.cpp"
            main.write_text(driver.replace("LAW", law.stem))
        _call("gcc", *STRICT, "-O1", "-c", law, "-o", f"{made}/law.o")
        include = [f"-I{made}", f"-I{folder}", f"-I{(folder / source).parent}"]
        _call("g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", *include, main, f"{made}/law.o", "-o", f"{made}/run")
        return _call(f"{made}/run", "host") if driver is None else _call(f"{made}/run")


def size_and_stack(folder: Path, compiler: str = "gcc", flags: tuple[str, ...] = ("-O3",)) -> tuple[int, int]:
    """Bytes of code and data, and of the stack by all functions together, of which any call needs only some."""
    with tempfile.TemporaryDirectory() as made:
        prefix = compiler.removesuffix("gcc").removesuffix("clang")
        _call(compiler, "-std=c99", *flags, "-fstack-usage", "-c", _source(folder), "-o", f"{made}/law.o")
        text, data, bss = _call(f"{prefix}size", f"{made}/law.o").splitlines()[1].split()[:3]
        usage = (Path(made) / "law.su").read_text().splitlines()
    return int(text) + int(data) + int(bss), sum(int(line.split("\t")[1]) for line in usage)


def ranges(folder: Path) -> str:
    """Raise Failed if Frama-C's EVA has an alarm for one step with everything in RANGES."""
    law = _source(folder)
    joints = int(re.search(r"_JOINTS (\d+)", law.with_suffix(".h").read_text())[1])  # type: ignore[index]
    kind = "float" if "typedef float" in law.with_suffix(".h").read_text() else "double"
    lines = "\n".join(f"        {x}[i] = Frama_C_{kind}_interval(-{most}, {most});" for x, most in RANGES.items())
    with tempfile.TemporaryDirectory() as made:
        main = Path(made) / "main.c"
        main.write_text(EVA.format(name=law.stem, n=joints, ranges=lines))
        printed = _call(
            "frama-c", "-eva", f"-cpp-extra-args=-I{folder} -std=c99", "-warn-special-float", "non-finite",
            "-eva-auto-loop-unroll", "2000", "-eva-subdivide-non-linear", "40", "-eva-no-show-progress", main, law,
        )  # fmt: skip
    found = re.search(r"(\d+) alarms? generated by the analysis", printed)
    if found is None:
        raise Failed(f"frama-c printed no summary: {printed[-500:]}")
    if found[1] != "0":
        raise Failed(f"{found[1]} alarms of EVA")
    return "no alarm of EVA"


def checks(folders: dict[str, Path]) -> Iterator[tuple[str, tuple[str, ...], Callable[[], str]]]:
    """What is checked, the programs that it needs, and the check, which returns what it found."""
    for name, folder in folders.items():
        for compiler in ("gcc", "clang"):
            for what, flags in FLAGS.items():
                needed = (compiler, f"{compiler}'s sanitizers") if what == SANITIZED else (compiler,)
                yield f"{name}, {compiler} {what}", needed, partial(self_test, folder, compiler, flags)
        yield f"{name}, symbols", ("gcc", "nm"), partial(symbols, folder)
        yield f"{name}, size", ("gcc", "size"), partial(_size, folder)
    for name in ("panda, nbs, double", "panda, nbs, float", "panda, adaptive, double", "kinova, pid, double"):
        folder = folders[name]
        aarch64 = partial(self_test, folder, AARCH64_GCC, ["-O2", "-static"], ("qemu-aarch64",))
        yield f"{name}, aarch64", (AARCH64_GCC, "qemu-aarch64"), aarch64
        yield f"{name}, Cortex-M7", (M7_GCC, "qemu-system-arm"), partial(_on_m7, folder)
        yield f"{name}, Cortex-M7 size", (M7_GCC,), partial(_size, folder, M7_GCC, (*M7, "-O2"))
    for name in ("panda, nbs, double", "panda, nbs, float", "two_link, computed-torque, double"):
        yield f"{name}, ranges", ("frama-c",), partial(ranges, folders[name])


def main() -> int:
    """Print every check and what it found; returns 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="names of checks begin with this")
    options = parser.parse_args()
    absent, failed, done = set(), 0, 0
    with tempfile.TemporaryDirectory() as place:
        for name, programs, check in checks(_exported(Path(place))):
            missing = [program for program in programs if not is_here(program)]
            absent |= set(missing)
            if missing or not name.startswith(options.only):
                continue
            done += 1
            try:
                print(f"{name}: {check().strip()}", flush=True)
            except Failed as error:
                failed += 1
                print(f"{name}: FAILED, {error}", flush=True)
    print(f"{done - failed} of {done} checks passed; absent here: {', '.join(sorted(absent)) or 'nothing'}")
    return int(failed > 0)


def _exported(place: Path) -> dict[str, Path]:
    """The laws that are checked: all of two_link, whole ones of panda, some with continuous joints."""
    cases = [("two_link", law, "double") for law in LAWS]
    cases += [("panda", law, kind) for law in ("nbs", "adaptive") for kind in ("double", "float")]
    cases += [("panda", "nbs-paper", "double"), *(("kinova", law, "double") for law in ("nbs", "adaptive", "pid"))]
    folders = {}
    for arm, name, precision in cases:
        law = build_law(name, nbs.load_robot(arm), friction=nbs.JointFriction.of(nbs.load_robot(arm)))
        if law.packable or isinstance(law, nbs.AdaptiveLaw):
            folders[f"{arm}, {name}, {precision}"] = folder = place / f"{arm}_{name}_{precision}"
            law.export(folder, precision=precision, rate_limit=1000.0)
    return folders


def _on_m7(folder: Path) -> str:
    board = ("-M", "mps2-an500", "-nographic", "-semihosting-config", "enable=on,target=native")
    start = (*M7, "-T", str(HERE / "cortex_m7.ld"), str(HERE / "cortex_m7.c"))
    return self_test(folder, M7_GCC, ["-O2"], ("qemu-system-arm", *board, "-kernel"), start)


def _size(folder: Path, compiler: str = "gcc", flags: tuple[str, ...] = ("-O3",)) -> str:
    size, stack = size_and_stack(folder, compiler, flags)
    found = f"{size} bytes of code and data, at most {stack} of stack"
    if size > MOST_BYTES or stack > MOST_STACK:
        raise Failed(found)
    return found


def _source(folder: Path) -> Path:
    (header,) = folder.glob("*.h")
    return header.with_suffix(".c")


def _call(*words: object) -> str:
    """What a program prints; raises Failed with what it complains of."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise Failed(f"{words[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
