"""Inertials of URDF, MJCF and SDF, in and out."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jrigid._checks import check_option, demand
from jrigid.io._extra import extra
from jrigid.io._physical import faults, nearest_physical
from jrigid.mass import MassProperties

_SIX = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
_FORMATS = {"robot": "urdf", "mujoco": "mjcf", "sdf": "sdf"}
_SUFFIXES = {".urdf": "robot", ".xml": "mujoco", ".mjcf": "mujoco", ".sdf": "sdf"}
_EMPTY = {
    "robot": "<robot name='bodies'/>",
    "mujoco": "<mujoco><worldbody/></mujoco>",
    "sdf": "<sdf version='1.9'><model name='bodies'/></sdf>",
}


class _Read(NamedTuple):
    """As a file says it: the tensor about the centre of mass, in axes that `turn` turns."""

    mass: float
    center: np.ndarray
    six: np.ndarray  # xx, yy, zz, xy, xz, yz
    turn: Any  # scipy's rotation, from the axes of the tensor to those of the link

    def tensor(self) -> np.ndarray:
        a, b, c, d, e, f = self.six
        turn = self.turn.as_matrix()
        return turn @ np.array([[a, d, e], [d, b, f], [e, f, c]]) @ turn.T


def _numbers(text: str | None, default: str | None = None, count: int = 1) -> np.ndarray:
    text = default if text is None else text
    if text is None:
        raise ValueError("a number is missing.")
    demand("$" not in text, f"{text!r} is a formula: expand it first, xacro by `xacro`.")
    values = np.array([float(x) for x in text.split()])
    demand(values.size == count, f"{text!r} must be {count} numbers, but it is not.")
    return values


def _turns() -> Any:
    return extra("scipy.spatial.transform").Rotation


def _read_urdf(inertial: ET.Element, _: ET.Element) -> _Read:
    """URDF: about the centre of mass, in axes turned by roll, pitch, yaw about fixed axes."""
    origin, mass, inertia = (
        (x.attrib if x is not None else {})
        for x in (inertial.find("origin"), inertial.find("mass"), inertial.find("inertia"))
    )
    six = [_numbers(inertia.get(k), "0" if k in ("ixy", "ixz", "iyz") else None)[0] for k in _SIX]
    turn = _turns().from_euler("xyz", _numbers(origin.get("rpy"), "0 0 0", 3))
    center = _numbers(origin.get("xyz"), "0 0 0", 3)
    return _Read(_numbers(mass.get("value"))[0], center, np.array(six), turn)


def _read_sdf(inertial: ET.Element, _: ET.Element) -> _Read:
    """SDF: as URDF, in elements; what is not given is 1 on the diagonal and 0 elsewhere."""
    demand(
        inertial.get("auto") not in ("true", "1"),
        "auto='true' leaves it to the simulator: use `jrigid.io.read_mesh`.",
    )
    pose, attributes = inertial.findtext("pose"), {}
    if (element := inertial.find("pose")) is not None:
        attributes = element.attrib
    demand(not attributes.get("relative_to"), "<pose> must be relative to the link.")
    if attributes.get("rotation_format", "euler_rpy") == "quat_xyzw":
        values = _numbers(pose, "0 0 0 0 0 0 1", 7)
        turn = _turns().from_quat(values[3:])
    else:
        values = _numbers(pose, "0 0 0 0 0 0", 6)
        degrees = attributes.get("degrees") in ("true", "1")
        turn = _turns().from_euler("xyz", values[3:], degrees=degrees)
    six = [
        _numbers(inertial.findtext(f"inertia/{k}"), f"{i == j:d}")[0] for k, (i, j) in _SIX.items()
    ]
    return _Read(_numbers(inertial.findtext("mass"), "1")[0], values[:3], np.array(six), turn)


def _read_mjcf(inertial: ET.Element, root: ET.Element) -> _Read:
    """MJCF: `fullinertia` in the body's axes, `diaginertia` in axes turned in one of five ways."""
    said = {k: x for compiler in root.iter("compiler") for k, x in compiler.attrib.items()}
    demand(
        said.get("inertiafromgeom") != "true",
        "inertiafromgeom='true' makes MuJoCo overlook it: take the tensor from the meshes.",
    )
    center, mass = _numbers(inertial.get("pos"), None, 3), _numbers(inertial.get("mass"))[0]
    if (full := inertial.get("fullinertia")) is not None:
        return _Read(mass, center, _numbers(full, None, 6), _turns().identity())
    six = np.append(_numbers(inertial.get("diaginertia"), None, 3), np.zeros(3))
    return _Read(mass, center, six, _mjcf_turn(inertial, said))


def _mjcf_turn(inertial: ET.Element, said: Mapping[str, str]) -> Any:
    turns, degrees = _turns(), said.get("angle", "degree") == "degree"
    unit = np.pi / 180 if degrees else 1.0
    if (text := inertial.get("quat")) is not None:
        return turns.from_quat(np.roll(_numbers(text, None, 4), -1))
    if (text := inertial.get("axisangle")) is not None:
        axis, angle = np.split(_numbers(text, None, 4), [3])
        return turns.from_rotvec(axis / np.linalg.norm(axis) * angle * unit)
    if (text := inertial.get("xyaxes")) is not None:
        x, y = _numbers(text, None, 6).reshape(2, 3)
        x = x / np.linalg.norm(x)
        y = y - (x @ y) * x
        y = y / np.linalg.norm(y)
        return turns.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1))
    if (text := inertial.get("zaxis")) is not None:
        z = _numbers(text, None, 3)
        across = np.array([-z[1], z[0], 0.0])
        sine = np.linalg.norm(across)
        axis = across / sine if sine > 0 else np.array([1.0, 0.0, 0.0])
        return turns.from_rotvec(axis * np.arctan2(sine, z[2]))
    turn = turns.identity()
    angles = _numbers(inertial.get("euler"), "0 0 0", 3) * unit
    for axis, angle in zip(said.get("eulerseq", "xyz"), angles, strict=True):
        one = turns.from_euler(axis.lower(), angle)
        turn = turn * one if axis.islower() else one * turn  # about moving or fixed axes
    return turn


_READERS = {"robot": _read_urdf, "mujoco": _read_mjcf, "sdf": _read_sdf}


def _root(source: str | Path) -> ET.Element:
    """The tree of a file, or of XML itself, with comments; MJCF's includes are read too."""
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    if isinstance(source, str) and source.lstrip().startswith("<"):
        root = ET.fromstring(source, parser)
    else:
        root = ET.parse(source, parser).getroot()
        for parent in list(root.iter()) if root.tag == "mujoco" else ():
            for i, child in reversed(list(enumerate(parent))):
                if child.tag == "include":
                    parent[i : i + 1] = list(_root(Path(source).parent / child.attrib["file"]))
    formats = ", ".join(f"<{k}> ({x.upper()})" for k, x in _FORMATS.items())
    demand(root.tag in _FORMATS, f"Argument `path` must be a {formats}, but it is a <{root.tag}>.")
    return root


def _links(root: ET.Element) -> dict[str, ET.Element]:
    """Links, or MJCF's bodies, by their names; SDF's with the models' where names repeat."""
    if root.tag != "sdf":
        elements = root.iter("link" if root.tag == "robot" else "body")
        return {x.get("name", f"body {i}"): x for i, x in enumerate(elements, 1)}

    def inside(
        element: ET.Element, scope: tuple[str, ...]
    ) -> Iterator[tuple[tuple[str, ...], Any]]:
        for child in element:
            name = (*scope, child.get("name", ""))
            if child.tag == "link":
                yield name, child
            elif child.tag in ("world", "model"):
                yield from inside(child, name if child.tag == "model" else scope)

    links = list(inside(root, ()))
    times = Counter(name[-1] for name, _ in links)
    return {"::".join(name) if times[name[-1]] > 1 else name[-1]: x for name, x in links}


def read_inertials(
    path: str | Path, *, unphysical: Literal["raise", "nearest", "keep"] = "raise"
) -> dict[str, MassProperties]:
    """Mass properties of the links of a URDF, MJCF or SDF file, by name, in the links' axes.

    The format is that of the root: `<robot>`, `<mujoco>`, `<sdf>`. Links without an inertial are
    left out, also those whose inertia MuJoCo would take from their shapes; SDF's links of one name
    in several models are called `model::link`.

    Args:
        path: The file, or its text.
        unphysical: What to do with inertials that no body can have: "raise" says in one error what
            is wrong with each (see `diagnose`); "nearest" takes the nearest tensors that a body
            can have (see `nearest_physical`); "keep" takes them as they are, as
            `MassProperties.unchecked` does.

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
    check_option("unphysical", unphysical, ("raise", "nearest", "keep"))
    root = _root(path)
    bodies, wrong = {}, []
    for name, link in _links(root).items():
        if (inertial := link.find("inertial")) is None:
            continue
        try:
            read = _READERS[root.tag](inertial, root)
        except ValueError as error:
            raise ValueError(f"The inertial of {name!r} cannot be read: {error}") from error
        tensor = read.tensor()
        found = faults(read.mass, read.center, tensor) if unphysical != "keep" else ()
        if unphysical == "nearest" and read.mass > 0 and np.all(np.isfinite(tensor)):
            tensor, found = nearest_physical(tensor), ()
        wrong += [f"{name!r}: {text}" for text in found]
        bodies[name] = MassProperties.unchecked(read.mass, read.center, tensor)
    demand(not wrong, "\n".join(["Some inertials are those of no body.", *wrong]))
    return bodies


def _child(element: ET.Element, tag: str) -> ET.Element:
    found = element.find(tag)
    return ET.SubElement(element, tag) if found is None else found


def _text(values: Any) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))


def _write(kind: str, link: ET.Element, body: MassProperties) -> None:
    """Replace what an inertial says of mass, centre and tensor, in the axes of the link."""
    inertial, tensor = _child(link, "inertial"), np.asarray(body.inertia)
    center = _text(body.center_of_mass)
    six = {key: _text(tensor[place]) for key, place in _SIX.items()}
    if kind == "mujoco":
        inertial.attrib.clear()
        inertial.attrib.update(
            pos=center, mass=_text(body.mass), fullinertia=" ".join(six.values())
        )
    elif kind == "robot":
        _child(inertial, "origin").attrib.update(xyz=center, rpy="0 0 0")
        _child(inertial, "mass").set("value", _text(body.mass))
        _child(inertial, "inertia").attrib.update(six)
    else:
        pose = _child(inertial, "pose")
        pose.attrib.clear()
        pose.text = f"{center} 0 0 0"
        _child(inertial, "mass").text = _text(body.mass)
        for key, text in six.items():
            _child(_child(inertial, "inertia"), key).text = text


def _new(kind: str, names: list[str]) -> ET.Element:
    """A file of links side by side, their axes in common."""
    root = ET.fromstring(_EMPTY[kind])
    for name in names:
        ET.SubElement(
            root if kind == "robot" else root[0], "body" if kind == "mujoco" else "link", name=name
        )
    for name in names[1:] if kind == "robot" else ():  # which must be a tree
        joint = ET.SubElement(root, "joint", name=f"to {name}", type="fixed")
        ET.SubElement(joint, "parent", link=names[0])
        ET.SubElement(joint, "child", link=name)
    return root


def write_inertials(
    path: str | Path, bodies: Mapping[str, MassProperties], *, template: str | Path | None = None
) -> None:
    """Write mass properties as the inertials of a URDF (.urdf), MJCF (.xml) or SDF (.sdf) file.

    Tensors are written in the axes of the link, about the centre of mass, to the last digit.

    Args:
        path: The file to write.
        bodies: By the names of the links, in their axes, centres of mass from their origins [m].
        template: A file, or its text, whose inertials are replaced (or added), and all else,
            comments too, kept; it may be `path` itself. None: a new file of these links alone, all
            in the same place; in URDF the others are fixed to the first.

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
        check_option("path", Path(path).suffix, tuple(_SUFFIXES))
        root = _new(_SUFFIXES[Path(path).suffix], list(bodies))
    else:
        root = _root(template)
    links = _links(root)
    strange = set(bodies) - set(links)
    demand(
        not strange,
        f"Argument `bodies` must name links of the template, but {sorted(strange)} are not among "
        f"{list(links)}.",
    )
    for name, body in bodies.items():
        _write(root.tag, links[name], body)
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
