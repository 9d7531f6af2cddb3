"""From a compiled model to an FMU: configuration header, C compiler, zip archive.

The archive contains the binary for this platform, every C source and header from which it was made, and the model
description. The same model and runtime give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from pathlib import Path

from fmu_build.cache import remove_unused, user_cache
from fmu_build.errors import BuildError
from fmu_build.model import CompiledModel, Location, Variable
from fmu_build.model_description import FmiVersion, model_description, states

DEFAULT_TOLERANCE = 1e-6
# Contraction into fused operations would make results depend on the processor that the compiler targets. Loops are
# over a handful of states: unrolling saves a fifth of the time, vectors of two cost more than they save. Loops
# over the directions of derivatives gain a tenth by vectors.
# Processors reorder instructions themselves: scheduling them takes an eighth of the compiler's time for nothing.
C_FLAGS = ("-std=c99", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden")
# Functions that a simulation seldom calls are not worth optimising. Equations are straight code without common
# expressions: -Og, which skips conversions of branches and passes over loops, takes three quarters of the time
# of -O1, and they run as fast. Communication points are many calls and short loops.
_FAST = ("-O2", "-funroll-loops", "-fno-tree-vectorize", "-fno-schedule-insns2")
_CALLS = ("-O2",)
_VECTORS = ("-O3",)
_PLAIN = ("-O1",)
_STRAIGHT = ("-Og",)
_SELDOM = ("-O0",)
Levels = Sequence[tuple[tuple[str, ...], tuple[str, ...]]]
# What depends on the model, compiled for each of them ...
_OF_MODEL: Levels = (
    (_STRAIGHT, ("model.c",)),
    (_FAST, ("equations.c", "stages.c", "dense_output.c")),
    (_SELDOM, ("model_rare.c", "model_data.c")),
)
# ... and what does not.
_GENERATED = {"model.c", "model_rare.c"}
_RUNTIME: Levels = (
    (_CALLS, ("evaluation.c", "simulate.c", "variables.c")),
    (_FAST, ("integrator.c", "linear.c", "past.c", "transport.c")),
    (_FAST, ("events.c", "kinks.c")),
    (_VECTORS, ("sensitivity.c",)),
    (_PLAIN, ("directions.c", "least_norm.c", "pivoting.c")),
    (_SELDOM, ("arrays.c", "assertions.c", "initialise.c", "lifecycle.c", "starts.c", "event_sensitivity.c")),
    (_SELDOM, ("delays.c", "sensitivity_rare.c", "pivoted_blocks.c")),
)
_HEADERS = (
    "collocation.h",
    "instance.h",
    "linear.h",
    "lu.h",
    "model_data.h",
    "newton.h",
    "past.h",
    "sensitivity.h",
    "variables.h",
)
_FMI_HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}


def package(model: CompiledModel, out: Path | str, *, fmi: FmiVersion = 2) -> Path:
    """Write the FMU of a compiled model.

    Parameters
    ----------
    model
        The compiled model.
    out
        Path of the ``.fmu`` to write, or of a folder: then it is ``<out>/<model name>.fmu``. An FMU there that was
        made from the same model, runtime and compiler is left as it is.
    fmi
        Major version of FMI: 2 or 3. Either way the FMU does co-simulation and model exchange.

    Returns
    -------
    Path
        The FMU.

    Raises
    ------
    BuildError
        No C compiler is found, or it fails.
    """
    out = Path(out)
    if out.suffix != ".fmu":
        out = out / f"{model.name}.fmu"
    if (fmi == 3 or not model.variables) and not any(v.causality == "independent" for v in model.variables):
        time = Variable("time", "Real", Location("t"), "independent", "continuous")
        model = replace(model, variables=(*model.variables, time))
    compiler = _compiler()
    files = _sources(model, fmi)
    key = _key(files, compiler).encode()
    if _comment(out) == key:
        return out
    sources = [name for name in files if name.endswith(".c")]
    description = model_description(model, _guid(model, fmi), sources, fmi)
    content = {"modelDescription.xml": description.encode()}
    content |= {f"sources/{name}": text.encode() for name, text in files.items()}
    if fmi == 3:
        content["sources/buildDescription.xml"] = _build_description(model, sources).encode()
    binary = f"binaries/{_platform(fmi)}/{model.name}{'.dylib' if platform.system() == 'Darwin' else '.so'}"
    content[binary] = _compile(model, files, compiler, fmi)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        _zip(partial, content, key)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return out


def _key(files: dict[str, str], compiler: tuple[str, ...]) -> str:
    """Digest of sources and of how they are compiled."""
    how = [*compiler, *C_FLAGS, repr((_OF_MODEL, _RUNTIME)), *_wanted_flags(), _version(compiler)]
    return hashlib.sha256(json.dumps([sorted(files.items()), how]).encode()).hexdigest()


def _guid(model: CompiledModel, fmi: FmiVersion) -> str:
    h = hashlib.sha256(json.dumps([model.content_hash, fmi, sorted(_runtime(fmi).items())]).encode()).hexdigest()
    return f"{{{h[:8]}-{h[8:12]}-{h[12:16]}-{h[16:20]}-{h[20:32]}}}"


def _runtime(fmi: FmiVersion) -> dict[str, str]:
    folder = resources.files("fmu_build") / "runtime"
    sources = {name for _, names in (*_OF_MODEL, *_RUNTIME) for name in names} - _GENERATED
    names = (f"fmi{fmi}.c", *sorted(sources), *_HEADERS)
    return {name: (folder / name).read_text() for name in names}


def _sources(model: CompiledModel, fmi: FmiVersion) -> dict[str, str]:
    """All files that the C compiler needs, by name; C files first."""
    headers = resources.files("fmu_build") / "runtime" / "fmi"
    files = {"model.c": model.c_source, "model_rare.c": model.c_rare, **_runtime(fmi), "model.h": model.c_header}
    files["model_config.h"] = configuration(model, _guid(model, fmi))
    files |= {name: (headers / name).read_text() for name in _FMI_HEADERS[fmi]}
    return files


def _text(value: str) -> str:
    """C string literal (JSON's escapes are C's for printable ASCII; the rest goes as octal UTF-8)."""
    escaped = "".join(
        {0x22: '\\"', 0x5C: "\\\\"}.get(b, chr(b) if 32 <= b < 127 else f"\\{b:03o}") for b in value.encode()
    )
    return f'"{escaped}"'


def _settable(v: Variable, of_states: Collection[str]) -> str:
    if v.causality == "input":
        return "SETTABLE_INPUT"
    if v.causality == "parameter" and v.location.vector == "p":
        return "SETTABLE_TUNABLE" if v.variability == "tunable" else "SETTABLE_FIXED"
    # A start value that follows from parameters gives way to one that is set, for runs that begin anywhere.
    if v.name in of_states or (v.location.vector == "x" and v.initial in ("exact", "approx")):
        return "SETTABLE_START"
    return "SETTABLE_NO"


def configuration(model: CompiledModel, guid: str) -> str:
    """Text of ``model_config.h``: the parts of the model description that the C runtime needs."""

    def initialiser(items: list[str]) -> str:
        return "{" + ", ".join(items or ["0"]) + "}"

    constants: list[float] = []
    entries = []
    of_states = {v.name for v in states(model)}
    for v in model.variables:
        index = v.location.index
        if v.location.vector == "constant":
            index = len(constants)
            constants.append(v.start if v.start is not None else 0.0)
        vector, settable = f"VECTOR_{v.location.vector.upper()}", _settable(v, of_states)
        kind = f"TYPE_{v.type.upper()}"
        entries.append(f"{{{vector}, {index}, {v.location.sign}, {kind}, {settable}, {_text(v.name)}}}")
    # FMI 3.0 also reads event indicators as variables: they follow the model's own.
    for i in range(model.n_m):
        entries.append(f'{{VECTOR_G, {i}, 1, TYPE_REAL, SETTABLE_NO, "event indicator {i + 1}"}}')

    def starts(vector: str, length: int) -> list[str]:
        values = [0.0] * length
        for v in model.variables:
            if v.location.vector == vector and v.start is not None and v.causality in ("input", "parameter"):
                values[v.location.index] = v.location.sign * v.start
        return [repr(float(value)) for value in values]

    state = states(model)
    macros = {
        "MODEL_IDENTIFIER": _text(model.name),
        "MODEL_GUID": _text(guid),
        "MODEL_TOLERANCE": repr(float(model.experiment.tolerance or DEFAULT_TOLERANCE)),
        "MODEL_N_VARIABLES": str(len(entries)),
        "MODEL_VARIABLES": "{ \\\n    " + ", \\\n    ".join(entries) + "}",
        "MODEL_HAS_INTEGERS": str(int(any(v.type == "Integer" for v in model.variables))),
        "MODEL_P_START": initialiser(starts("p", model.n_p)),
        "MODEL_U_START": initialiser(starts("u", model.n_u)),
        "MODEL_CONSTANTS": initialiser([repr(float(c)) for c in constants]),
        "MODEL_X_NAME": initialiser([_text(v.name) for v in state]),
        "MODEL_X_SCALE": initialiser([repr(float(v.nominal or 0.0)) for v in state]),
    }
    lines = [f"#define {name} {value}" for name, value in macros.items()]
    return _CONFIGURATION.replace("@MACROS@", "\n".join(lines))


_CONFIGURATION = """\
/* Variables of the model by value reference, start values and names. Generated. */
#ifndef FMUID_MODEL_CONFIG_H
#define FMUID_MODEL_CONFIG_H

#include "variables.h"

@MACROS@

#endif
"""


def _compiler() -> tuple[str, ...]:
    wanted = os.environ.get("CC")
    if wanted:
        return tuple(wanted.split())
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return (name,)
    raise BuildError("no C compiler found", fix="install gcc or set the environment variable CC")


def _wanted_flags() -> tuple[str, ...]:
    """Return the flags of the user, which come last and so take precedence."""
    return tuple(os.environ.get("FMU_BUILD_CFLAGS", "").split())


def _version(compiler: tuple[str, ...]) -> str:
    try:
        done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise BuildError(
            f"the C compiler does not run: {error}", fix="check the environment variable CC"
        ) from error
    return done.stdout


def _compile(model: CompiledModel, files: dict[str, str], compiler: tuple[str, ...], fmi: FmiVersion) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder, files)
        commands, objects = _commands(folder, compiler, _OF_MODEL)
        runtime = _compiled_runtime(files, compiler, fmi)
        if runtime is None:
            more, runtime = _commands(folder, compiler, _runtime_levels(fmi))
            commands += more
        _run_together(folder, model.class_name, *commands)
        link = [*compiler, *C_FLAGS, "-shared", "-o", "model.so", *objects, *runtime, "-lm"]
        _run_together(folder, model.class_name, link)
        return (folder / "model.so").read_bytes()


def _write(folder: Path, files: dict[str, str]) -> None:
    for file, text in files.items():
        (folder / file).write_text(text)


def _runtime_levels(fmi: FmiVersion) -> Levels:
    (flags, files), *others = _RUNTIME
    return ((flags, (*files, f"fmi{fmi}.c")), *others)


def _commands(folder: Path, compiler: tuple[str, ...], levels: Levels) -> tuple[list[list[str]], list[str]]:
    """Compiler commands and their objects; by relative names, so that nothing of this machine is in them."""
    commands = []
    for (flags, files), name in zip(levels, _names(levels), strict=True):
        one = f"{name}.c"  # as one source, so that the headers are read once
        (folder / one).write_text("".join(f'#include "{file}"\n' for file in files))
        commands.append([*compiler, *C_FLAGS, *flags, *_wanted_flags(), "-c", one])
    return commands, [f"{name}.o" for name in _names(levels)]


def _names(levels: Levels) -> list[str]:
    return [f"{files[0].removesuffix('.c')}_and_others" for _, files in levels]


def _compiled_runtime(files: dict[str, str], compiler: tuple[str, ...], fmi: FmiVersion) -> list[str] | None:
    """Return the objects of the runtime, which is compiled once; None if there is no place to keep them."""
    names = {name for _, names in _runtime_levels(fmi) for name in names} | {*_HEADERS, *_FMI_HEADERS[fmi]}
    sources = {name: files[name] for name in names}
    cache = user_cache().resolve() / "runtime"
    folder = cache / _key(sources, compiler)
    ready = [str(folder / f"{name}.o") for name in _names(_runtime_levels(fmi))]
    try:
        if folder.is_dir():
            os.utime(folder)
            return ready
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as name:
            _write(Path(name), sources)
            commands, objects = _commands(Path(name), compiler, _runtime_levels(fmi))
            _run_together(Path(name), "the runtime", *commands)
            kept = Path(name, "kept")
            kept.mkdir()
            for file in objects:
                Path(name, file).rename(kept / file)
            with suppress(OSError):  # another process was faster
                kept.rename(folder)
        remove_unused(cache, "*")
    except OSError:
        return None
    return ready if folder.is_dir() else None


def _run_together(folder: Path, class_name: str, *commands: list[str]) -> None:
    """Run compiler commands in parallel; the first one that fails is reported."""
    running = [
        subprocess.Popen(c, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for c in commands
    ]
    printed = [process.communicate()[1] for process in running]
    for process, text in zip(running, printed, strict=True):
        if process.returncode != 0:
            first = next((line for line in text.splitlines() if "error" in line), text.strip())
            raise BuildError(f"the C compiler failed: {first}", where=class_name)


def _platform(fmi: FmiVersion) -> str:
    system, machine = platform.system(), platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    names = {"Linux": "linux", "Darwin": "darwin"}
    if system not in names:
        raise BuildError(f"FMUs cannot be built on {system}", fix="use Linux or macOS")
    if fmi == 2:
        if machine != "x86_64":
            return f"{machine}-{names[system]}"
        return f"{names[system]}64"
    return f"{machine}-{names[system]}"


def _build_description(model: CompiledModel, sources: list[str]) -> str:
    files = "\n".join(f'      <SourceFile name="{name}"/>' for name in sources)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{model.name}">\n'
        f'    <SourceFileSet language="C99">\n{files}\n    </SourceFileSet>\n'
        "  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )


def _comment(path: Path) -> bytes | None:
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.comment
    except (OSError, zipfile.BadZipFile):
        return None


def _zip(path: Path, content: dict[str, bytes], comment: bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(content):
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            info.create_system = 3
            archive.writestr(info, content[name])
        archive.comment = comment
