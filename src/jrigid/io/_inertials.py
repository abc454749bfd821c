"""Inertials of URDF, MJCF and SDF: read and write."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args
from xml.sax.saxutils import quoteattr

import numpy as np

from jrigid._checks import check_option, check_type, demand
from jrigid._extra import extra
from jrigid.io._physical import faults, nearest_physical, values_of
from jrigid.io._xml import around_root, document, tree_of
from jrigid.mass import MassProperties

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SIX = {
    "ixx": (0, 0),
    "iyy": (1, 1),
    "izz": (2, 2),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyz": (1, 2),
}
# A new file and a link in it, by suffix.
_NEW = {
    ".urdf": ("<robot name='bodies'>{}</robot>", "<link name={}/>"),
    ".xml": ("<mujoco><worldbody>{}</worldbody></mujoco>", "<body name={}/>"),
    ".sdf": (
        "<sdf version='1.9'><model name='bodies'>{}</model></sdf>",
        "<link name={}/>",
    ),
}
# Roll, pitch, yaw about fixed axes, in MJCF's words.
_RPY = {"angle": "radian", "eulerseq": "XYZ"}
# SDF's poses where none is given, by their format.
_POSES = {"euler_rpy": "0 0 0 0 0 0", "quat_xyzw": "0 0 0 0 0 0 1"}
_SAVED = "save the compiled model by `mujoco.mj_saveLastXML`"
# Links that a program makes: in which format, by which element, and what to do.
_MADE = (
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
    (
        "mujoco",
        ".//frame/inertial",
        f"an `<inertial>` is in a `<frame>`, which moves it: {_SAVED} and read that.",
    ),
)
# Options of MJCF's compiler that change masses.
_MASS_OPTIONS = ("settotalmass", "boundmass", "boundinertia")
# MJCF's ways to state a rotation.
_TURNS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
# MuJoCo refuses directions that are shorter than this.
_LEAST_LENGTH = 1e-14
# Python's `float` also takes `1_0` and digits of other scripts; simulators do not.
_NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity)",
    re.ASCII | re.IGNORECASE,
)

_Unphysical = Literal["raise", "nearest", "keep"]


class _Stated(NamedTuple):
    """Attributes that a file states of an inertial.

    Attributes:
        attributes: As MJCF's attributes, whatever the format.
        options: How angles are meant, as the attributes of MJCF's compiler.
    """

    attributes: Mapping[str, str]
    options: Mapping[str, str]


def _refuse_twins(inertial: ET.Element) -> None:
    """Raise ValueError where an element of an inertial is stated twice."""
    # Comments have a function in place of a tag.
    tags = [x.tag for x in inertial.iter() if isinstance(x.tag, str)]
    twins = sorted({x for x in tags if tags.count(x) > 1})
    demand(not twins, f"it has {', '.join(f'two <{x}>' for x in twins)}.")


def _urdf(inertial: ET.Element, _: ET.Element) -> _Stated:
    """An inertial of URDF. Source: wiki.ros.org/urdf/XML/link."""
    _refuse_twins(inertial)
    known = {f"{x.tag} {k}": text for x in inertial for k, text in x.attrib.items()}
    mass, *six = _texts(known, "mass value", *(f"inertia {k}" for k in _SIX))
    attributes = {
        "mass": mass,
        "fullinertia": " ".join(six),
        "pos": known.get("origin xyz", "0 0 0"),
        "euler": known.get("origin rpy", "0 0 0"),
    }
    return _Stated(attributes, _RPY)


def _sdf(inertial: ET.Element, _: ET.Element) -> _Stated:
    """An inertial of SDF. Source: SDFormat 1.12, inertial."""
    is_automatic = _flag(inertial.attrib, "auto")
    demand(not is_automatic, "`auto` is for the simulator to compute.")
    _refuse_twins(inertial)
    known = {x.tag: _text_of(x) for x in inertial.iter()}
    about = getattr(inertial.find("pose"), "attrib", {})
    position, turn, options = _sdf_pose(known.get("pose", ""), about)
    # SDF takes the identity where a moment or a product is absent, and a mass of 1.
    six = [known.get(k) or f"{i == j:d}" for k, (i, j) in _SIX.items()]
    attributes = {
        "mass": known.get("mass") or "1",
        "fullinertia": " ".join(six),
        "pos": position,
    }
    return _Stated(attributes | turn, options)


def _text_of(element: ET.Element) -> str:
    """The text of an element, also that behind comments."""
    parts = [element.text, *(part.tail for part in element)]
    return " ".join(filter(None, parts)).strip()


def _sdf_pose(
    text: str, about: Mapping[str, str]
) -> tuple[str, dict[str, str], Mapping[str, str]]:
    """Position, turn and meaning of the angles, in MJCF's words."""
    demand(not about.get("relative_to"), "Its pose must be relative to the link.")
    kind = about.get("rotation_format", "euler_rpy")
    check_option("rotation_format", kind, tuple(_POSES))
    pose = text or _POSES[kind]
    _numbers(pose, len(_POSES[kind].split()))
    x, y, z, *turn = pose.split()
    position = f"{x} {y} {z}"
    if kind == "quat_xyzw":
        # MJCF's quaternions are scalar first.
        return position, {"quat": " ".join([turn[3], *turn[:3]])}, {}
    unit = "degree" if _flag(about, "degrees") else "radian"
    return position, {"euler": " ".join(turn)}, _RPY | {"angle": unit}


def _mjcf(inertial: ET.Element, root: ET.Element) -> _Stated:
    """An inertial of MJCF. Source: MuJoCo, XML reference, body/inertial."""
    options: dict[str, str] = {}
    for compiler in root.iter("compiler"):  # the last one wins
        options |= compiler.attrib
    is_global = options.get("coordinate") == "global"
    demand(not is_global, "global coordinates, which MuJoCo no longer takes.")
    from_shapes = options.get("inertiafromgeom") == "true"
    demand(not from_shapes, "`inertiafromgeom` makes MuJoCo overlook it.")
    for name in _MASS_OPTIONS:
        advice = f"{_SAVED}, delete `{name}` there and read that."
        # Zero and negative values, MuJoCo's defaults, switch these options off.
        is_set = _number(options.get(name, "0")) > 0
        demand(not is_set, f"`{name}` makes MuJoCo change it: {advice}")
    known = inertial.attrib
    is_full = "fullinertia" in known
    rivals = (*_TURNS, "fullinertia", "diaginertia") if is_full else _TURNS
    given = [k for k in rivals if k in known]
    demand(len(given) <= 1, f"MuJoCo takes only one of {', '.join(given)}.")
    _texts(known, "mass", "pos", "fullinertia" if is_full else "diaginertia")
    # This gives way to the `fullinertia` of the file, if it has one.
    full = {"fullinertia": f"{known.get('diaginertia')} 0 0 0"}
    return _Stated(full | known, options)


#: Function of an inertial and the root of its file.
_Reader = Callable[[ET.Element, ET.Element], _Stated]
_FORMATS: dict[str, _Reader] = {"robot": _urdf, "mujoco": _mjcf, "sdf": _sdf}


def _texts(known: Mapping[str, str], *names: str) -> list[str]:
    """The texts of these names, none of which may be missing or blank."""
    missing = [k for k in names if not known.get(k, "").strip()]
    demand(not missing, f"it has no {', no '.join(missing)}.")
    return [known[k] for k in names]


def _flag(attributes: Mapping[str, str], name: str) -> bool:
    """A boolean of SDF, False where it is absent."""
    value = attributes.get(name, "false").lower()
    check_option(name, value, ("true", "1", "false", "0"))
    return value in ("true", "1")


def _number(text: str) -> float:
    """A number as simulators read it."""
    is_number = _NUMBER.fullmatch(text.strip())
    demand(bool(is_number), f"{text!r} must be a number, but it is not.")
    return float(text)


def _numbers(text: str, count: int) -> np.ndarray:
    """Numbers between white space."""
    demand("$" not in text, f"{text!r} is a formula: expand it first, by `xacro`.")
    values = np.array([_number(x) for x in text.split()])
    demand(values.size == count, f"{text!r} must be {count} numbers, but it is not.")
    return values


def _direction(vector: np.ndarray, name: str) -> np.ndarray:
    """A vector of an attribute over its length."""
    size = np.linalg.norm(vector)
    message = f"`{name}` must state a direction, but a vector is 0 or two are parallel."
    demand(bool(size > _LEAST_LENGTH), message)
    return vector / size


def _turn(stated: _Stated) -> "Rotation":
    """The rotation from the axes of the tensor to those of the link."""
    attributes, options = stated
    rotations = extra("io", "scipy.spatial.transform").Rotation
    angle = options.get("angle", "degree")
    check_option("angle", angle, ("degree", "radian"))
    unit = np.pi / 180 if angle == "degree" else 1.0
    if text := attributes.get("quat"):
        return rotations.from_quat(np.roll(_numbers(text, 4), -1))
    if text := attributes.get("axisangle"):
        axis, angle = np.split(_numbers(text, 4), [3])
        return rotations.from_rotvec(_direction(axis, "axisangle") * angle * unit)
    if text := attributes.get("xyaxes"):
        x, y = (_direction(v, "xyaxes") for v in _numbers(text, 6).reshape(2, 3))
        # MuJoCo keeps the direction of x and makes y orthogonal to it.
        z = _direction(np.cross(x, y), "xyaxes")
        return rotations.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
    if text := attributes.get("zaxis"):
        # The shortest turn to that axis; of half a turn that about x.
        x, y, z = _direction(_numbers(text, 3), "zaxis")
        # Scalar last, as scipy takes it. The shortest turn from unit z to unit v has
        # the quaternion (1 + z . v, z x v), up to its norm.
        half = [-y, x, 0.0, 1 + z]
        return rotations.from_quat(half if np.any(half) else [1.0, 0.0, 0.0, 0.0])
    angles = _numbers(attributes.get("euler") or "0 0 0", 3) * unit
    turn = rotations.identity()
    for axis, angle in zip(options.get("eulerseq", "xyz"), angles, strict=True):
        one = rotations.from_euler(axis.lower(), angle)
        # Small letters are axes that move with the body, capitals fixed ones.
        turn = turn * one if axis.islower() else one * turn
    return turn


def _read(
    inertial: ET.Element, root: ET.Element
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, tensor about it in the axes of the link."""
    stated = _FORMATS[root.tag](inertial, root)
    # MJCF's order: xx yy zz xy xz yz.
    a, b, c, d, e, f = _numbers(stated.attributes["fullinertia"], 6)
    turn = _turn(stated).as_matrix()
    tensor = turn @ np.array([[a, d, e], [d, b, f], [e, f, c]]) @ turn.T
    mass = float(_numbers(stated.attributes["mass"], 1)[0])
    return mass, _numbers(stated.attributes["pos"], 3), tensor


def _links(root: ET.Element) -> dict[str, ET.Element]:
    """Links, or MJCF's bodies, by name.

    Where an SDF file has several models, their names stand before those of the links.
    """
    check_option("path", root.tag, tuple(_FORMATS))
    scopes = {root: ""}
    # In the order of the document a model comes before those within, which need its
    # name.
    for parent in root.iter() if root.tag == "sdf" else ():
        outer = scopes.get(parent, "")
        for model in parent.iterfind("model"):
            scopes[model] = f"{outer}{model.get('name')}::"
    is_one_model = len(scopes) <= 2  # beside the root
    links = {}
    for model, scope in scopes.items():
        elements = model.iterfind(".//body" if root.tag == "mujoco" else "link")
        for i, element in enumerate(elements, 1):
            # Bodies of MJCF may have no name.
            name = element.get("name", f"body {i}")
            name = name if is_one_model else scope + name
            message = f"Names of links must be unique, but {name!r} is not."
            demand(name not in links, message)
            links[name] = element
    return links


def _refuse_made_links(argument: str, root: ET.Element) -> None:
    """Raise ValueError for a file whose links, or their inertials, a program makes."""
    for tag, place, message in _MADE:
        is_made = root.tag == tag and root.find(place) is not None
        demand(
            not is_made,
            f"Argument `{argument}` must hold all links itself, but {message}",
        )


def read_inertials(
    path: str | Path, *, unphysical: _Unphysical = "raise", thickness: float = 0.0
) -> dict[str, MassProperties]:
    """Read the mass properties of the links of a URDF, MJCF or SDF file, by name.

    The format is that of the root: `<robot>`, `<mujoco>` or `<sdf>`. Bodies are in the
    axes of their links. Links without an inertial are left out, also those whose
    inertia MuJoCo would take from their shapes. The links of an SDF file of several
    models are called `model::link`, of nested ones `outer::inner::link`. Files that
    MJCF includes are read where MuJoCo reads them.

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
        ValueError: A file of another kind, XML that is not well-formed, or an include
            that MuJoCo refuses (a file that is missing, empty or included twice); a
            file whose links or numbers its program makes of others (macros, SDF's
            includes, MJCF's `replicate`, `settotalmass`); numbers that are missing, are
            formulas or are none; bodies that are none in the precision of jax (float32
            but with `jax_enable_x64`). The text names the file and the link.
        FileNotFoundError: No such file.

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
    source = document(path)
    root = tree_of(source)
    _refuse_made_links("path", root)
    bodies = {}
    wrong = []
    for name, link in _links(root).items():
        inertials = link.findall("inertial")
        demand(
            len(inertials) < 2,
            f"A link must have one `<inertial>` at most, but {name!r} has "
            f"{len(inertials)}.",
        )
        if not inertials:
            continue
        (inertial,) = inertials
        try:
            mass, center, tensor = _read(inertial, root)
        except ValueError as error:
            where = "" if source.path is None else f"{source.name}: "
            message = f"{where}The inertial of {name!r} cannot be read: {error}"
            raise ValueError(message) from error
        if unphysical == "nearest":
            tensor = np.asarray(nearest_physical(tensor, mass, thickness))
        body = MassProperties.unchecked(mass, center, tensor)
        bodies[name] = body
        if unphysical != "keep":
            wrong += [f"{name!r}: {text}" for text in faults(*values_of(body))]
    demand(not wrong, "\n".join(["Some inertials are those of no body.", *wrong]))
    return bodies


def _written(kind: str, body: MassProperties) -> ET.Element:
    """An inertial in the axes of the link."""
    center = _joined(body.center_of_mass)
    mass = _joined(body.mass)
    six = {k: _joined(body.inertia[ij]) for k, ij in _SIX.items()}
    if kind == "mujoco":
        full = " ".join(six.values())
        text = f"pos='{center}' mass='{mass}' fullinertia='{full}'"
        return ET.fromstring(f"<inertial {text}/>")
    if kind == "robot":
        pose = f"<origin xyz='{center}' rpy='0 0 0'/><mass value='{mass}'/>"
        inertia = " ".join(f"{k}='{x}'" for k, x in six.items())
        return ET.fromstring(f"<inertial>{pose}<inertia {inertia}/></inertial>")
    pose = f"<pose>{center} 0 0 0</pose><mass>{mass}</mass>"
    inertia = "".join(f"<{k}>{x}</{k}>" for k, x in six.items())
    return ET.fromstring(f"<inertial>{pose}<inertia>{inertia}</inertia></inertial>")


def _joined(value: object) -> str:
    """All digits of the numbers of an array."""
    return " ".join(map(str, np.ravel(np.asarray(value))))


def _check_body(name: str, body: object) -> None:
    """Raise ValueError unless an argument is one body with finite numbers."""
    check_type(name, body, MassProperties)
    assert isinstance(body, MassProperties)
    mass = np.asarray(body.mass)
    numbers = (mass, body.center_of_mass, body.inertia)
    message = f"Argument `{name}` must be one body, but it is a batch of {mass.size}."
    demand(mass.shape == (), message)
    are_finite = all(np.all(np.isfinite(x)) for x in numbers)
    demand(are_finite, f"Argument `{name}` must be finite, but it is not.")


def _refuse_other_format(path: str | Path, root: ET.Element) -> None:
    """Raise ValueError where the suffix of a file promises another format."""
    kind = {".urdf": "robot", ".sdf": "sdf"}.get(Path(path).suffix, root.tag)
    demand(
        kind == root.tag,
        f"Argument `path` must have the suffix of its format, but {Path(path).name!r} "
        f"would hold a template of root <{root.tag}>.",
    )


def write_inertials(
    path: str | Path,
    bodies: Mapping[str, MassProperties],
    *,
    template: str | Path | None = None,
) -> None:
    """Write mass properties as the inertials of a URDF, MJCF or SDF file.

    Tensors are written in the axes of the link, about the centre of mass, to the last
    digit of their precision. The format of a new file is that of its suffix: `.urdf`,
    `.xml` or `.sdf`.

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
        ValueError: A suffix of no format or of another than the template's, a batch of
            bodies, a number that is not finite, a link that the template has not, or a
            template that `read_inertials` could not read (macros, broken XML).

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
        _check_body(f"bodies[{name!r}]", body)
    if template is None:
        check_option("path", Path(path).suffix, tuple(_NEW))
        file, link = _NEW[Path(path).suffix]
        template = file.format("".join(link.format(quoteattr(name)) for name in bodies))
    source = document(template)
    root = tree_of(source)
    _refuse_made_links("template", root)
    _refuse_other_format(path, root)
    links = _links(root)
    strange = sorted(set(bodies) - set(links))
    message = f"but {strange} are not in it."
    demand(not strange, f"Argument `bodies` must name links of the template, {message}")
    for name, body in bodies.items():
        old = links[name].find("inertial")
        if old is not None:
            links[name].remove(old)
        links[name].insert(0, _written(root.tag, body))
    ET.indent(root)
    before, after = around_root(source)
    head = "<?xml version='1.0' encoding='utf-8'?>\n"
    text = f"{head}{before}{ET.tostring(root, 'unicode')}\n{after}"
    Path(path).write_text(text, encoding="utf-8")
