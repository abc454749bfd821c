"""Inertials of URDF, MJCF and SDF, in and out."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any, Literal, get_args
from xml.sax.saxutils import quoteattr

import numpy as np

from jrigid._checks import check_option, check_type, demand
from jrigid._extra import extra
from jrigid.io._physical import faults, nearest_physical, values_of
from jrigid.mass import MassProperties

_SIX = {
    "ixx": (0, 0),
    "iyy": (1, 1),
    "izz": (2, 2),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyz": (1, 2),
}
_NEW = {  # a file and a link in it
    ".urdf": ("<robot name='bodies'>{}</robot>", "<link name={}/>"),
    ".xml": ("<mujoco><worldbody>{}</worldbody></mujoco>", "<body name={}/>"),
    ".sdf": (
        "<sdf version='1.9'><model name='bodies'>{}</model></sdf>",
        "<link name={}/>",
    ),
}
_RPY = {
    "angle": "radian",
    "eulerseq": "XYZ",
}  # roll, pitch, yaw about fixed axes, in MJCF's words

_POSES = {
    "euler_rpy": "0 0 0 0 0 0",
    "quat_xyzw": "0 0 0 0 0 0 1",
}  # SDF's, where none is given
_SAVED = "save the compiled model by `mujoco.mj_saveLastXML`"
_MADE = (  # links that a program makes: in which format, of what, what to do
    (
        "sdf",
        ".//include",
        "`<include>` adds models: expand it first, `gz sdf -p a.sdf > b.sdf`.",
    ),
    (
        "mujoco",
        ".//replicate//body",
        f"`<replicate>` makes bodies: {_SAVED} and read that.",
    ),
    ("mujoco", ".//attach", f"`<attach>` adds bodies: {_SAVED} and read that."),
)
_MACROS = "Argument `path` must be expanded, but it has macros: `xacro a.xacro > a.urdf` first."
_TURNS = "quat", "axisangle", "xyaxes", "zaxis", "euler"  # MJCF's

_Unphysical = Literal["raise", "nearest", "keep"]
# Each of these says an inertial as MJCF's attributes, and how its angles are meant.
_Said = tuple[Mapping[str, str], Mapping[str, str]]


def _urdf(inertial: ET.Element, _: ET.Element) -> _Said:
    known = {f"{x.tag} {k}": text for x in inertial for k, text in x.attrib.items()}
    mass, *six = _texts(known, "mass value", *(f"inertia {k}" for k in _SIX))
    pose = {
        "pos": known.get("origin xyz", "0 0 0"),
        "euler": known.get("origin rpy", "0 0 0"),
    }
    return {"mass": mass, "fullinertia": " ".join(six), **pose}, _RPY


def _sdf(inertial: ET.Element, _: ET.Element) -> _Said:
    texts = {
        x.tag: [x.text, *(part.tail for part in x)] for x in inertial.iter()
    }  # past comments
    known = {tag: " ".join(filter(None, parts)).strip() for tag, parts in texts.items()}
    about = getattr(inertial.find("pose"), "attrib", {})
    demand(
        not _flag(inertial.attrib, "auto"), "`auto` is for the simulator to compute."
    )
    demand(not about.get("relative_to"), "Its pose must be relative to the link.")
    kind = about.get("rotation_format", "euler_rpy")
    check_option("rotation_format", kind, tuple(_POSES))
    pose = known.get("pose") or _POSES[kind]
    _numbers(pose, len(_POSES[kind].split()))
    x, y, z, *turn = pose.split()
    six = " ".join(known.get(k) or f"{i == j:d}" for k, (i, j) in _SIX.items())
    said = {"mass": known.get("mass") or "1", "fullinertia": six, "pos": f"{x} {y} {z}"}
    if kind == "quat_xyzw":
        return {**said, "quat": " ".join([turn[3], *turn[:3]])}, {}
    unit = "degree" if _flag(about, "degrees") else "radian"
    return {**said, "euler": " ".join(turn)}, _RPY | {"angle": unit}


def _mjcf(inertial: ET.Element, root: ET.Element) -> _Said:
    options = {
        k: x for compiler in root.iter("compiler") for k, x in compiler.attrib.items()
    }
    demand(
        options.get("inertiafromgeom") != "true",
        "`inertiafromgeom` makes MuJoCo overlook it.",
    )
    for k in ("settotalmass", "boundmass", "boundinertia"):
        message = (
            f"`{k}` makes MuJoCo change it: {_SAVED}, delete `{k}` there and read that."
        )
        demand(float(options.get(k, 0)) <= 0, message)
    known, full = inertial.attrib, "fullinertia" in inertial.attrib
    rivals = (*_TURNS, "fullinertia", "diaginertia") if full else _TURNS
    given = [k for k in rivals if k in known]
    demand(len(given) <= 1, f"MuJoCo takes only one of {', '.join(given)}.")
    _texts(known, "mass", "pos", "fullinertia" if full else "diaginertia")
    return {"fullinertia": f"{known.get('diaginertia')} 0 0 0", **known}, options


_FORMATS = {"robot": _urdf, "mujoco": _mjcf, "sdf": _sdf}


def _texts(known: Mapping[str, str], *names: str) -> list[str]:
    missing = [k for k in names if not known.get(k, "").strip()]
    demand(not missing, f"it has no {', no '.join(missing)}.")
    return [known[k] for k in names]


def _flag(attributes: Mapping[str, str], name: str) -> bool:
    """A truth of SDF."""
    value = attributes.get(name, "false").lower()
    check_option(name, value, ("true", "1", "false", "0"))
    return value in ("true", "1")


def _numbers(text: str, count: int) -> np.ndarray:
    demand("$" not in text, f"{text!r} is a formula: expand it first, by `xacro`.")
    values = np.array([float(x) for x in text.split()])
    demand(values.size == count, f"{text!r} must be {count} numbers, but it is not.")
    return values


def _turn(said: Mapping[str, str], options: Mapping[str, str]) -> Any:
    """From the axes of the tensor to those of the link."""
    turns = extra("io", "scipy.spatial.transform").Rotation
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
    if text := said.get(
        "zaxis"
    ):  # the shortest turn there, of half a turn that about x
        x, y, z = _numbers(text, 3)
        half = [-y, x, 0.0, np.linalg.norm([x, y, z]) + z]
        return turns.from_quat(half if np.any(half) else [1.0, 0.0, 0.0, 0.0])
    turn = turns.identity()
    angles = _numbers(said.get("euler") or "0 0 0", 3) * unit
    for axis, angle in zip(options.get("eulerseq", "xyz"), angles, strict=True):
        one = turns.from_euler(axis.lower(), angle)
        turn = (
            turn * one if axis.islower() else one * turn
        )  # about moving or fixed axes
    return turn


def _read(
    inertial: ET.Element, root: ET.Element
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, tensor about it in the axes of the link."""
    said, options = _FORMATS[root.tag](inertial, root)
    a, b, c, d, e, f = _numbers(said["fullinertia"], 6)
    turn = _turn(said, options).as_matrix()
    tensor = turn @ np.array([[a, d, e], [d, b, f], [e, f, c]]) @ turn.T
    return float(_numbers(said["mass"], 1)[0]), _numbers(said["pos"], 3), tensor


def _opened(source: str | Path) -> Any:
    """The path of a file, or what reads as the file of this text."""
    text = source.strip() if isinstance(source, str) else ""
    return StringIO(text) if text.startswith("<") else Path(source)


def _root(source: str | Path, main: Path | None = None) -> ET.Element:
    """The tree of a file, or of XML itself, with comments; MJCF's includes are read too.

    They are looked for beside the main file, then beside the file that they are in.
    """
    builder = ET.TreeBuilder(insert_comments=True, insert_pis=True)
    file = _opened(source)
    root = ET.parse(file, ET.XMLParser(target=builder)).getroot()
    demand(not any("/xacro}" in str(x.tag) for x in root.iter()), _MACROS)
    for parent in list(root.iter()) if root.tag not in ("robot", "sdf") else ():
        for child in parent.findall("include"):
            message = "Argument `path` must be a path, but it is the text of a file with includes."
            demand(isinstance(file, Path), message)
            i, name, top = list(parent).index(child), child.attrib["file"], main or file
            beside = top if (top.parent / name).exists() else file
            parent[i : i + 1] = list(_root(beside.parent / name, top))
    return root


def _links(root: ET.Element) -> dict[str, ET.Element]:
    """Links, or MJCF's bodies, by their names; SDF's with the models' where there are several."""
    check_option("path", root.tag, tuple(_FORMATS))
    models, links = {root: ""}, {}
    for parent in root.iter() if root.tag == "sdf" else ():
        own = models.get(parent, "")
        models |= {x: f"{own}{x.get('name')}::" for x in parent.iterfind("model")}
    for model, scope in models.items():
        elements = model.iterfind(".//body" if root.tag == "mujoco" else "link")
        for i, element in enumerate(elements, 1):
            name = scope * (len(models) > 2) + element.get("name", f"body {i}")
            demand(
                name not in links,
                f"Names of links must be unique, but {name!r} is not.",
            )
            links[name] = element
    return links


def read_inertials(
    path: str | Path, *, unphysical: _Unphysical = "raise", thickness: float = 0.0
) -> dict[str, MassProperties]:
    """Mass properties of the links of a URDF, MJCF or SDF file, by name, in the links' axes.

    The format is that of the root: `<robot>`, `<mujoco>`, `<sdf>`. Links without an
    inertial are left out, also those whose inertia MuJoCo would take from their shapes;
    the links of an SDF file of several models are called `model::link`, of nested ones
    `outer::inner::link`.

    Args:
        path: The file, or its text.
        unphysical: What to do with inertials that no body can have: "raise" says in one
            error what is wrong with each (see `diagnose`); "nearest" takes the nearest
            tensors that a body can have (see `nearest_physical`); "keep" takes them as
            they are, as `MassProperties.unchecked` does.
        thickness: Of "nearest": no body is thinner than a plate of this thickness [m].
            MuJoCo, which allows no rounding, may refuse flat ones.

    Returns:
        The bodies; centres of mass from the origins of their links.

    Raises:
        ValueError: A file of another kind, or whose links or numbers its program makes
            of others (macros, SDF's includes, MJCF's `replicate`, `settotalmass`);
            numbers that are missing or that are formulas; bodies that are none in the
            precision of jax (float32 but with `jax_enable_x64`), by the names of the
            links.

    Source: URDF, wiki.ros.org/urdf/XML/link; MuJoCo, XML reference, body/inertial;
        SDFormat 1.12, inertial. All three mean tensors about the centre of mass with
        ixy = -sum m x y.

    >>> import jrigid as jr
    >>> text = "<inertial mass='2' pos='0 0 1' diaginertia='1 2 2.5' euler='0 0 90'/>"
    >>> text = f"<mujoco><worldbody><body name='box'>{text}</body></worldbody></mujoco>"
    >>> print(jr.io.read_inertials(text)["box"].inertia.diagonal().round(6))
    [2.  1.  2.5]
    """
    check_option("unphysical", unphysical, get_args(_Unphysical))
    root = _root(path)
    for tag, place, message in _MADE:
        found = root.tag == tag and root.find(place) is not None
        demand(not found, f"Argument `path` must hold all links itself, but {message}")
    bodies, wrong = {}, []
    for name, link in _links(root).items():
        if (inertial := link.find("inertial")) is None:
            continue
        try:
            mass, center, tensor = _read(inertial, root)
        except ValueError as error:
            raise ValueError(
                f"The inertial of {name!r} cannot be read: {error}"
            ) from error
        if unphysical == "nearest":
            tensor = np.asarray(nearest_physical(tensor, mass, thickness))
        bodies[name] = body = MassProperties.unchecked(mass, center, tensor)
        if unphysical != "keep":
            wrong += [f"{name!r}: {text}" for text in faults(*values_of(body))]
    demand(not wrong, "\n".join(["Some inertials are those of no body.", *wrong]))
    return bodies


def _written(kind: str, body: MassProperties) -> ET.Element:
    """An inertial in the axes of the link."""
    center, mass, *values = (
        " ".join(map(str, np.ravel(value)))
        for value in (
            body.center_of_mass,
            body.mass,
            *(body.inertia[ij] for ij in _SIX.values()),
        )
    )
    if kind == "mujoco":
        text = f"pos='{center}' mass='{mass}' fullinertia='{' '.join(values)}'"
        return ET.fromstring(f"<inertial {text}/>")
    if kind == "robot":
        text = " ".join(f"{k}='{x}'" for k, x in zip(_SIX, values, strict=True))
        text = f"<origin xyz='{center}' rpy='0 0 0'/><mass value='{mass}'/><inertia {text}/>"
    else:
        text = "".join(f"<{k}>{x}</{k}>" for k, x in zip(_SIX, values, strict=True))
        text = (
            f"<pose>{center} 0 0 0</pose><mass>{mass}</mass><inertia>{text}</inertia>"
        )
    return ET.fromstring(f"<inertial>{text}</inertial>")


def _around(source: str | Path) -> tuple[str, str]:
    """Comments before and after the root; the prefixes of its namespaces are kept from now on."""
    depth, before, around = 0, True, ["", ""]
    events = ("start", "end", "comment", "pi", "start-ns")
    for event, x in ET.iterparse(_opened(source), events):
        depth += (event == "start") - (event == "end")
        before &= event != "start"
        if event == "start-ns" and x[0].strip("0123456789") not in (
            "",
            "ns",
        ):  # as ET takes
            ET.register_namespace(*x)
        elif event in ("comment", "pi") and not depth:
            around[not before] += ET.tostring(x, "unicode").strip() + "\n"
    return around[0], around[1]


def write_inertials(
    path: str | Path,
    bodies: Mapping[str, MassProperties],
    *,
    template: str | Path | None = None,
) -> None:
    """Write mass properties as the inertials of a URDF (.urdf), MJCF (.xml) or SDF (.sdf) file.

    Tensors are written in the axes of the link, about the centre of mass, to the last
    digit of their precision.

    Args:
        path: The file to write.
        bodies: By the names of the links, in their axes, centres of mass from their
            origins [m].
        template: A file, or its text, whose inertials are replaced (or added), and all
            other elements and comments kept; white space, quotes and a DOCTYPE are not,
            and what an MJCF includes is written into it. It may be `path` itself. None:
            a new file of these links alone, without joints, which a URDF of several
            needs.

    Raises:
        ValueError: A suffix of no format, a link that the template has not, a template
            with macros.

    >>> import jrigid as jr
    >>> from tempfile import TemporaryDirectory
    >>> box = jr.solids.box(2.0, [0.1, 0.2, 0.3])
    >>> with TemporaryDirectory() as folder:
    ...     jr.io.write_inertials(f"{folder}/box.urdf", {"box": box})
    ...     print(jr.io.read_inertials(f"{folder}/box.urdf")["box"].mass)
    2.0
    """
    check_type("bodies", bodies, Mapping)
    for name, body in bodies.items():
        check_type(f"bodies[{name!r}]", body, MassProperties)
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
    before, after = _around(template)
    text = f"{before}{ET.tostring(root, 'unicode')}\n{after}"
    Path(path).write_text(
        f"<?xml version='1.0' encoding='utf-8'?>\n{text}", encoding="utf-8"
    )
