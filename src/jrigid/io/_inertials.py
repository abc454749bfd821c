"""Inertials of URDF, MJCF and SDF, in and out."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args
from xml.sax.saxutils import quoteattr

import numpy as np

from jrigid._checks import check_option, demand
from jrigid.io._extra import extra
from jrigid.io._physical import faults, nearest_physical
from jrigid.mass import MassProperties

_SIX = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
_NEW = {  # a file and a link in it
    ".urdf": ("<robot name='bodies'>{}</robot>", "<link name={}/>"),
    ".xml": ("<mujoco><worldbody>{}</worldbody></mujoco>", "<body name={}/>"),
    ".sdf": ("<sdf version='1.9'><model name='bodies'>{}</model></sdf>", "<link name={}/>"),
}
_RPY = {"angle": "radian", "eulerseq": "XYZ"}  # roll, pitch, yaw about fixed axes, in MJCF's words

_Unphysical = Literal["raise", "nearest", "keep"]
# Each of these says an inertial as MJCF's attributes, and how its angles are meant.
_Said = tuple[Mapping[str, str | None], Mapping[str, str]]


def _urdf(inertial: ET.Element, _: ET.Element) -> _Said:
    known = {k: text for child in inertial for k, text in child.attrib.items()}
    six = " ".join(known.get(k, "") for k in _SIX)
    pose = {"pos": known.get("xyz", "0 0 0"), "euler": known.get("rpy", "0 0 0")}
    return {"mass": known.get("value"), "fullinertia": six, **pose}, _RPY


def _sdf(inertial: ET.Element, _: ET.Element) -> _Said:
    known = {child.tag: child.text or "" for child in inertial.iter()}
    about = getattr(inertial.find("pose"), "attrib", {})
    demand(inertial.get("auto") not in ("true", "1"), "`auto` is for the simulator to compute.")
    demand(not about.get("relative_to"), "Its pose must be relative to the link.")
    six = " ".join(known.get(k, f"{i == j:d}") for k, (i, j) in _SIX.items())
    pose = known.get("pose", "0 0 0 0 0 0").split()
    said = {"mass": known.get("mass", "1"), "fullinertia": six, "pos": " ".join(pose[:3])}
    if about.get("rotation_format") == "quat_xyzw":
        return {**said, "quat": " ".join([*pose[6:], *pose[3:6]])}, {}
    unit = "degree" if about.get("degrees") in ("true", "1") else "radian"
    return {**said, "euler": " ".join(pose[3:])}, _RPY | {"angle": unit}


def _mjcf(inertial: ET.Element, root: ET.Element) -> _Said:
    options = {k: x for compiler in root.iter("compiler") for k, x in compiler.attrib.items()}
    demand(options.get("inertiafromgeom") != "true", "`inertiafromgeom` makes MuJoCo overlook it.")
    full = inertial.get("diaginertia", "") + " 0 0 0"
    return {"fullinertia": full, **inertial.attrib}, options


_FORMATS = {"robot": _urdf, "mujoco": _mjcf, "sdf": _sdf}


def _numbers(text: str | None, count: int) -> np.ndarray:
    demand("$" not in (text or ""), f"{text!r} is a formula: expand it first, by `xacro`.")
    values = np.array([float(x) for x in (text or "").split()])
    demand(values.size == count, f"{text!r} must be {count} numbers, but it is not.")
    return values


def _turn(said: Mapping[str, str | None], options: Mapping[str, str]) -> Any:
    """From the axes of the tensor to those of the link."""
    turns = extra("scipy.spatial.transform").Rotation
    unit = np.pi / 180 if options.get("angle", "degree") == "degree" else 1.0
    if text := said.get("quat"):
        return turns.from_quat(np.roll(_numbers(text, 4), -1))
    if text := said.get("axisangle"):
        axis, angle = np.split(_numbers(text, 4), [3])
        return turns.from_rotvec(axis / np.linalg.norm(axis) * angle * unit)
    if text := said.get("xyaxes"):
        x, y = _numbers(text, 6).reshape(2, 3)
        z = np.cross(x, y)
        axes = [v / np.linalg.norm(v) for v in (x, np.cross(z, x), z)]
        return turns.from_matrix(np.stack(axes, axis=1))
    if text := said.get("zaxis"):  # the shortest turn there, of half a turn that about x
        x, y, z = _numbers(text, 3)
        half = [-y, x, 0.0, np.linalg.norm([x, y, z]) + z]
        return turns.from_quat(half if np.any(half) else [1.0, 0.0, 0.0, 0.0])
    turn = turns.identity()
    angles = _numbers(said.get("euler") or "0 0 0", 3) * unit
    for axis, angle in zip(options.get("eulerseq", "xyz"), angles, strict=True):
        one = turns.from_euler(axis.lower(), angle)
        turn = turn * one if axis.islower() else one * turn  # about moving or fixed axes
    return turn


def _read(inertial: ET.Element, root: ET.Element) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, tensor about it in the axes of the link."""
    said, options = _FORMATS[root.tag](inertial, root)
    a, b, c, d, e, f = _numbers(said["fullinertia"], 6)
    turn = _turn(said, options).as_matrix()
    tensor = turn @ np.array([[a, d, e], [d, b, f], [e, f, c]]) @ turn.T
    return float(_numbers(said.get("mass"), 1)[0]), _numbers(said.get("pos"), 3), tensor


def _root(source: str | Path) -> ET.Element:
    """The tree of a file, or of XML itself, with comments; MJCF's includes are read too."""
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    if isinstance(source, str) and source.lstrip().startswith("<"):
        root = ET.fromstring(source, parser)
    else:
        root = ET.parse(source, parser).getroot()
        for parent in list(root.iter()) if root.tag not in ("robot", "sdf") else ():
            for child in parent.findall("include"):
                i = list(parent).index(child)
                parent[i : i + 1] = list(_root(Path(source).parent / child.attrib["file"]))
    return root


def _links(root: ET.Element) -> dict[str, ET.Element]:
    """Links, or MJCF's bodies, by their names; SDF's with the model's where there are several."""
    check_option("path", root.tag, tuple(_FORMATS))
    models, links = list(root.iter("model")) if root.tag == "sdf" else [root], {}
    for model in models:
        scope = f"{model.get('name')}::" if len(models) > 1 else ""
        elements = model.iterfind(".//body" if root.tag == "mujoco" else "link")
        for i, element in enumerate(elements, 1):
            name = scope + element.get("name", f"body {i}")
            demand(name not in links, f"Names of links must be unique, but {name!r} is not.")
            links[name] = element
    return links


def read_inertials(
    path: str | Path, *, unphysical: _Unphysical = "raise", thickness: float = 0.0
) -> dict[str, MassProperties]:
    """Mass properties of the links of a URDF, MJCF or SDF file, by name, in the links' axes.

    The format is that of the root: `<robot>`, `<mujoco>`, `<sdf>`. Links without an inertial are
    left out, also those whose inertia MuJoCo would take from their shapes; the links of an SDF file
    of several models are called `model::link`.

    Args:
        path: The file, or its text.
        unphysical: What to do with inertials that no body can have: "raise" says in one error what
            is wrong with each (see `diagnose`); "nearest" takes the nearest tensors that a body
            can have (see `nearest_physical`); "keep" takes them as they are, as
            `MassProperties.unchecked` does.
        thickness: Of "nearest": no body is thinner than a plate of this thickness [m]. MuJoCo,
            which allows no rounding, may refuse flat ones.

    Returns:
        The bodies; centres of mass from the origins of their links.

    Raises:
        ValueError: A file of another kind, numbers that are missing or that are formulas,
            or bodies that are none, by the names of the links.

    Source: URDF, wiki.ros.org/urdf/XML/link; MuJoCo, XML reference, body/inertial; SDFormat 1.12,
        inertial. All three mean tensors about the centre of mass with ixy = -sum m x y.

    >>> import jrigid as jr
    >>> text = "<inertial mass='2' pos='0 0 1' diaginertia='1 2 2.5' euler='0 0 90'/>"
    >>> text = f"<mujoco><worldbody><body name='box'>{text}</body></worldbody></mujoco>"
    >>> print(jr.io.read_inertials(text)["box"].inertia.diagonal().round(6))
    [2.  1.  2.5]
    """
    check_option("unphysical", unphysical, get_args(_Unphysical))
    root = _root(path)
    bodies, wrong = {}, []
    for name, link in _links(root).items():
        if (inertial := link.find("inertial")) is None:
            continue
        try:
            mass, center, tensor = _read(inertial, root)
        except ValueError as error:
            raise ValueError(f"The inertial of {name!r} cannot be read: {error}") from error
        if unphysical == "nearest":
            tensor = np.asarray(nearest_physical(tensor, mass, thickness))
        if unphysical != "keep":
            wrong += [f"{name!r}: {text}" for text in faults(mass, center, tensor)]
        bodies[name] = MassProperties.unchecked(mass, center, tensor)
    demand(not wrong, "\n".join(["Some inertials are those of no body.", *wrong]))
    return bodies


def _written(kind: str, body: MassProperties) -> ET.Element:
    """An inertial in the axes of the link."""
    center, mass, *values = (
        " ".join(repr(float(x)) for x in np.ravel(value))
        for value in (body.center_of_mass, body.mass, *(body.inertia[ij] for ij in _SIX.values()))
    )
    if kind == "mujoco":
        text = f"pos='{center}' mass='{mass}' fullinertia='{' '.join(values)}'"
        return ET.fromstring(f"<inertial {text}/>")
    if kind == "robot":
        text = " ".join(f"{k}='{x}'" for k, x in zip(_SIX, values, strict=True))
        text = f"<origin xyz='{center}' rpy='0 0 0'/><mass value='{mass}'/><inertia {text}/>"
    else:
        text = "".join(f"<{k}>{x}</{k}>" for k, x in zip(_SIX, values, strict=True))
        text = f"<pose>{center} 0 0 0</pose><mass>{mass}</mass><inertia>{text}</inertia>"
    return ET.fromstring(f"<inertial>{text}</inertial>")


def write_inertials(
    path: str | Path, bodies: Mapping[str, MassProperties], *, template: str | Path | None = None
) -> None:
    """Write mass properties as the inertials of a URDF (.urdf), MJCF (.xml) or SDF (.sdf) file.

    Tensors are written in the axes of the link, about the centre of mass, to the last digit.

    Args:
        path: The file to write.
        bodies: By the names of the links, in their axes, centres of mass from their origins [m].
        template: A file, or its text, whose inertials are replaced (or added), and all else,
            comments too, kept; it may be `path` itself. None: a new file of these links alone,
            without joints, which a URDF of several needs.

    Raises:
        ValueError: A suffix of no format, or a link that the template has not.

    >>> import jrigid as jr
    >>> from tempfile import TemporaryDirectory
    >>> box = jr.solids.box(2.0, [0.1, 0.2, 0.3])
    >>> with TemporaryDirectory() as folder:
    ...     jr.io.write_inertials(f"{folder}/box.urdf", {"box": box})
    ...     print(jr.io.read_inertials(f"{folder}/box.urdf")["box"].mass)
    2.0
    """
    if template is None:
        check_option("path", Path(path).suffix, tuple(_NEW))
        file, link = _NEW[Path(path).suffix]
        template = file.format("".join(link.format(quoteattr(name)) for name in bodies))
    links = _links(root := _root(template))
    strange = sorted(set(bodies) - set(links))
    message = f"Argument `bodies` must name links of the template, but {strange} are not in it."
    demand(not strange, message)
    for name, body in bodies.items():
        if (old := links[name].find("inertial")) is not None:
            links[name].remove(old)
        links[name].insert(0, _written(root.tag, body))
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
