"""The compiled parts of fmuid; everything else is in pyproject.toml.

The stepper is plain C without Python's headers, loaded by ctypes: one build serves every version of Python.
"""

from setuptools import Extension, setup

FOLDER = "src/fmuid/simulation"
SOURCES = ("stepper.c", "model_exchange.c", "coupled/master.c")
EXPORTED = ("run", "run_coupled", "plan_size", "clear_log", "read_log", "log_fmi2", "log_fmi3", "reads_after")

setup(
    ext_modules=[
        Extension(
            "fmuid.simulation._stepper",
            [f"{FOLDER}/{name}" for name in SOURCES],
            depends=[f"{FOLDER}/stepper.h"],
            # Contraction to fused multiply-adds would make the results depend on the machine.
            extra_compile_args=["-std=c11", "-O2", "-ffp-contract=off"],
            export_symbols=[f"fmuid_{name}" for name in EXPORTED],
            py_limited_api=True,
        ),
        Extension(  # of FMUs with laws: see fmu_with_laws.py
            "fmuid.simulation._fmu_with_laws",
            [f"{FOLDER}/{name}" for name in ("fmu_with_laws.c", "laws.c", "stepper.c", "model_exchange.c")],
            depends=[f"{FOLDER}/stepper.h", f"{FOLDER}/laws.h"],
            define_macros=[("FMUID_WITH_LAWS", "1")],
            # Its functions must be its own, whatever else the process has loaded.
            extra_compile_args=["-std=c11", "-O2", "-ffp-contract=off", "-fvisibility=hidden"],
            export_symbols=["fmi2Instantiate"],
            py_limited_api=True,
        ),
        Extension(  # the FMU of `fmuid demo`
            "fmuid.demo._drive",
            ["src/fmuid/demo/drive.c"],
            extra_compile_args=["-std=c11", "-O2", "-ffp-contract=off"],
            export_symbols=["fmi2Instantiate"],
            py_limited_api=True,
        ),
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
