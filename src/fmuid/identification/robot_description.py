"""Writing friction, damping and armature of joints to a robot description (URDF or MJCF)."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

from fmu_build.suggest import suggestion
from fmuid.core.campaign import RobotSpec
from fmuid.core.errors import CampaignError
from fmuid.core.formulas import parse

# Names of a joint's quantities: element below the joint (itself if there is none) and attribute.
_NAMES: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "robot": {"friction": ("dynamics", "friction"), "damping": ("dynamics", "damping")},
    "mujoco": {"friction": ("", "frictionloss"), "damping": ("", "damping"), "armature": ("", "armature")},
}
_FORMATS = {"robot": "URDF", "mujoco": "MJCF"}


def described(spec: RobotSpec, values: Mapping[str, float]) -> str:
    """Return the description with the joints' values replaced; everything else is unchanged.

    Both formats are in SI units: N.m (N) for friction, N.m.s/rad (N.s/m) for damping, kg.m2 (kg) for armature. The
    formulas must give values in these units. Sources: http://wiki.ros.org/urdf/XML/joint; MuJoCo XML reference,
    body/joint.

    Raises
    ------
    CampaignError
        The file is neither URDF nor MJCF, has no such joint, or the format has no such quantity.
    """
    try:
        builder = ElementTree.TreeBuilder(insert_comments=True)
        root = ElementTree.fromstring(spec.file.read_bytes(), ElementTree.XMLParser(target=builder))
    except (OSError, ElementTree.ParseError, ValueError, LookupError) as error:
        fix = "name a URDF or MJCF file"
        raise CampaignError(f"cannot be read ({error})", where=spec.file, fix=fix) from None
    if root.tag not in _NAMES:
        what = f"'{root.tag}' is neither a URDF robot nor a MuJoCo model"
        raise CampaignError(what, where=spec.file, fix="name a URDF or MJCF file")
    joints = {joint.get("name", ""): joint for joint in root.iter("joint")}
    for name, quantities in spec.joints.items():
        if name not in joints:
            raise CampaignError(f"has no joint '{name}'", where=spec.file, fix=suggestion(name, joints))
        for quantity, text in quantities.items():
            if quantity not in _NAMES[root.tag]:
                what = f"{_FORMATS[root.tag]} has no joint {quantity}"
                raise CampaignError(
                    what, where=f"[robot.joints.{name}]", fix=suggestion(quantity, _NAMES[root.tag])
                )
            below, attribute = _NAMES[root.tag][quantity]
            formula = parse(text, where=f"[robot.joints.{name}] {quantity}")
            element = joints[name]
            if below:
                child = element.find(below)
                element = ElementTree.SubElement(element, below) if child is None else child
            element.set(attribute, f"{formula(values):.9g}")
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
