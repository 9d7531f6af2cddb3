"""FMUs for the tests, made from oscillator.c in a moment: well-behaved ones and ones that are not."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import fmpy

from tests.conftest import c_compiler

SOURCE = Path(__file__).with_name("oscillator.c")
HEADERS = Path(fmpy.__file__).parent / "c-code"

# name, value reference, FMI 2.0 type, FMI 3.0 type, attributes
_VARIABLES = [
    ("time", 0, "Real", "Float64", 'causality="independent" variability="continuous"', ""),
    ("m", 1, "Real", "Float64", 'causality="parameter" variability="fixed" description="mass"', 'start="1" unit="kg" min="0"'),
    ("d", 2, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="0.5"'),
    ("c", 3, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="100"'),
    ("gain", 4, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="1"'),
    ("u", 5, "Real", "Float64", 'causality="input" variability="continuous"', 'start="0" unit="N"'),
    ("x", 6, "Real", "Float64", 'causality="local" variability="continuous" initial="exact"', 'start="0.1" unit="m"'),
    ("v", 7, "Real", "Float64", 'causality="local" variability="continuous" initial="exact"', 'start="0"'),
    ("y", 8, "Real", "Float64", 'causality="output" variability="continuous"', ""),
    ("der(x)", 9, "Real", "Float64", 'causality="local" variability="continuous"', 'derivative="{x}"'),
    ("der(v)", 10, "Real", "Float64", 'causality="local" variability="continuous"', 'derivative="{v}"'),
    ("flip", 11, "Boolean", "Boolean", 'causality="input" variability="discrete"', 'start="false"'),
    ("fault", 12, "Integer", "Int32", 'causality="parameter" variability="tunable"', 'start="0"'),
    ("bias", 13, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="3"'),
    ("count", 14, "Integer", "Int32", 'causality="output" variability="discrete"', ""),
    ("level", 15, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="0"'),
    ("ticks", 16, "Integer", "Int32", 'causality="output" variability="discrete"', ""),
    ("mode", 17, "Enumeration", "Int64", 'causality="parameter" variability="fixed"', 'start="1"'),
    ("sum", 19, "Real", "Float64", 'causality="output" variability="continuous"', ""),
    ("zero", 20, "Real", "Float64", 'causality="calculatedParameter" variability="fixed"', ""),
    ("kick", 22, "Real", "Float64", 'causality="parameter" variability="tunable"', 'start="0"'),
    ("w", 21, "Real", "Float64", 'causality="input" variability="continuous"', 'start="0"'),
]  # fmt: skip
FAULTS = {
    "crash": 1, "hang": 2, "nan": 3, "fails": 4, "leaks": 5, "devours": 6, "fatal": 7, "ends": 8, "segfault": 9,
    "slow": 10, "leaves": 11, "interrupts": 12,
}  # fmt: skip


def _description(
    fmi: int, interfaces: tuple[str, ...], once: bool, even_steps: bool | float, interpolates: bool, clock: bool
) -> str:
    index = {"x": 7, "v": 8} if fmi == 2 else {"x": 6, "v": 7}
    lines = []
    for name, vr, type2, type3, outer, inner in _VARIABLES:
        inner = inner.format(**index)
        if fmi == 2:
            kind = ' declaredType="Mode"' if type2 == "Enumeration" else ""
            lines.append(
                f'<ScalarVariable name="{name}" valueReference="{vr}" {outer}><{type2} {inner}{kind}/></ScalarVariable>'
            )
        else:
            kind = ' declaredType="Mode"' if type3 == "Enumeration" else ""
            lines.append(f'<{type3} name="{name}" valueReference="{vr}" {outer} {inner}{kind}/>')
    if fmi == 3:
        lines.append(
            '<Float64 name="table" valueReference="18" causality="parameter" variability="fixed" start="0 1 2 3 4 5">'
            '<Dimension start="2"/><Dimension start="3"/></Float64>'
        )
    if clock:
        lines.append(
            '<Clock name="tick" valueReference="30" causality="input" intervalVariability="constant" intervalDecimal="0.1"/>'
        )
        lines.append('<Binary name="picture" valueReference="31" causality="output" variability="discrete"/>')
    flags = f'canBeInstantiatedOnlyOncePerProcess="{str(once).lower()}"'
    steps = f'canHandleVariableCommunicationStepSize="{str(not even_steps).lower()}"'
    declared = "" if isinstance(even_steps, bool) else f' stepSize="{even_steps}"'
    if fmi == 2:
        steps += f' canInterpolateInputs="{str(interpolates).lower()}"'
    offered = "".join(
        f'<{i} modelIdentifier="oscillator" {flags} {steps if i == "CoSimulation" else ""}/>' for i in interfaces
    )
    variables = "\n".join(lines)
    if fmi == 2:
        types = '<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="a" value="1"/><Item name="b" value="2"/></Enumeration></SimpleType></TypeDefinitions>'
        structure = (
            '<Outputs><Unknown index="9"/><Unknown index="15"/><Unknown index="17"/><Unknown index="19"/></Outputs>'
            '<Derivatives><Unknown index="10"/><Unknown index="11"/></Derivatives>'
        )
        head = 'fmiVersion="2.0" guid="oscillator" numberOfEventIndicators="1"'
    else:
        types = '<TypeDefinitions><EnumerationType name="Mode"><Item name="a" value="1"/><Item name="b" value="2"/></EnumerationType></TypeDefinitions>'
        structure = (
            '<Output valueReference="8"/><Output valueReference="14"/><Output valueReference="16"/><Output valueReference="19"/>'
            '<ContinuousStateDerivative valueReference="9"/><ContinuousStateDerivative valueReference="10"/>'
            '<EventIndicator valueReference="6"/>'
        )
        head = 'fmiVersion="3.0" instantiationToken="oscillator"'
    units = "".join(f'<Unit name="{u}"/>' for u in ("kg", "N", "m"))
    experiment = f'<DefaultExperiment startTime="0" stopTime="1" tolerance="1e-7"{declared}/>'
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription modelName="Oscillator" {head}>{offered}'
        f"<UnitDefinitions>{units}</UnitDefinitions>{types}{experiment}<ModelVariables>{variables}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def make_oscillator(
    folder: Path,
    fmi: int = 2,
    interfaces: tuple[str, ...] = ("CoSimulation",),
    defines: tuple[str, ...] = (),
    *,
    even_steps: bool | float = False,
    interpolates: bool = False,
    clock: bool = False,
) -> Path:
    """Compile and pack the test FMU; `defines` are the macros of oscillator.c, a number for `even_steps` is declared."""
    name = "-".join(["oscillator", str(fmi), *(i[:2] for i in interfaces), *defines]).replace("=", "")
    path = (
        folder
        / f"{name}{f'-even{even_steps}' if even_steps else ''}{'-interpolates' if interpolates else ''}{'-clock' if clock else ''}.fmu"
    )
    library = path.with_suffix(".so")
    command = [c_compiler(), "-std=gnu11", "-O0", "-shared", "-fPIC", "-Wno-div-by-zero", f"-DFMI={fmi}"]
    command += [*(f"-D{d}" for d in defines), f"-I{HEADERS}", "-o", str(library), str(SOURCE), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    place = fmpy.platform if fmi == 2 else fmpy.platform_tuple
    description = _description(fmi, interfaces, "ONCE" in defines, even_steps, interpolates, clock)
    if any(d.startswith(("NOISE", "DECLARES")) for d in defines):
        offer = f'<ModelExchange providesDirectionalDerivative{"s" if fmi == 3 else ""}="true" '
        description = description.replace("<ModelExchange ", offer)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.writestr("resources/readme.txt", "nothing")
        archive.write(library, f"binaries/{place}/oscillator{fmpy.sharedLibraryExtension}")
    return path
