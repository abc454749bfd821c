"""Write free_rotation.npz: free motions of every kind at 30 digits,
for tests of the exact flow.

Run as `python tests/data/make_free_rotation.py`; it takes about ten seconds. The cases
are drawn with a fixed seed, and the motions come from tests/free_reference.py.

Arrays, one row a case: `regime` (name), `level` (how far from the degenerate case the
regime is named after; 0 where that means nothing), `inertia` (n, 3), `tensor` (n, 3, 3;
the case's inertia in regime "tensor", where `inertia` is NaN; else diagonal),
`attitude`, `omega`, `time`, and the state then, `attitude_out` and `omega_out`, each
the nearest double, with `attitude_low` and `omega_low` what is left of it: value = out
+ low to 32 digits. The sign of the attitude is continuous in time.
"""

import itertools
import sys
from fractions import Fraction
from math import isqrt
from pathlib import Path

import mpmath as mp
import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from free_reference import free_motion  # noqa: E402

TURNS = 2 * np.pi * 1e6
NEAR = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 1e-15)


def excess(moments, omega):
    """L^2 - 2 E I2, exactly; 0 on the separatrix."""
    pairs = sorted(
        zip((Fraction(x) for x in moments), (Fraction(x) for x in omega), strict=True)
    )
    square = sum((i * w) ** 2 for i, w in pairs)
    return square - sum(i * w * w for i, w in pairs) * pairs[1][0]


def separatrices():
    """Small whole moments and omega (p, anything, q) exactly on the separatrix."""
    out = [((1.0, 2.0, 2.25), 3, 4)]
    for i1, i2, i3 in itertools.combinations(range(1, 13), 3):
        up, down = (i3 - i2) * i3, (i2 - i1) * i1
        root = isqrt(up * down)
        if root * root == up * down:
            ratio = Fraction(root, down)
            out.append(
                ((float(i1), float(i2), float(i3)), ratio.numerator, ratio.denominator)
            )
    return out


class Cases:
    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.rows = []
        self.separatrices = separatrices()

    # Draws

    def physical(self):
        s = self.rng.uniform(0.1, 1, 3)
        moments = np.sort(s.sum() - s)
        return moments * 10 ** self.rng.uniform(-1, 1)

    def unphysical(self, decades):
        moments = 10 ** self.rng.uniform(0, decades, 3)
        moments[0], moments[2] = 1, 10**decades
        return self.rng.permutation(moments)

    def direction(self):
        return self.rng.normal(size=3)

    def sign(self):
        return self.rng.choice([-1.0, 1.0])

    def radians(self, longest):
        if self.rng.uniform() < 0.04:
            return 0.0
        sign = -1 if self.rng.uniform() < 0.3 else 1
        return sign * 10 ** self.rng.uniform(-1, np.log10(longest))

    def add(self, regime, inertia, omega, level=0.0, unstable=False):
        inertia, omega = np.asarray(inertia, float), np.asarray(omega, float)
        longest = 100.0 if unstable and self.rng.uniform() < 0.75 else TURNS
        speed = np.max(np.abs(omega))
        speed = speed * np.linalg.norm(omega / speed) if speed > 0 else 1.0
        attitude = self.rng.normal(size=4)
        attitude /= np.linalg.norm(attitude)
        time = self.radians(longest) / speed
        self.rows.append((regime, level, inertia, attitude, omega, time))

    # Regimes

    def generic(self):
        for _ in range(60):
            for regime, sign in (("long axis", -1), ("short axis", 1)):
                moments, omega = self.physical(), self.direction()
                while excess(moments, omega) * sign <= 0:
                    moments, omega = self.physical(), self.direction()
                self.add(regime, moments, omega)
        for order in itertools.permutations(range(3)):
            for _ in range(10):
                self.add("reordered", self.physical()[list(order)], self.direction())
        for regime, unit in (("omega x 1e-7", 1e-7), ("omega x 1e4", 1e4)):
            for _ in range(50):
                self.add(
                    regime,
                    self.rng.permutation(self.physical()),
                    unit * self.direction(),
                )
        for regime, decades in (("unphysical 1e3", 3), ("unphysical 1e6", 6)):
            for _ in range(50):
                self.add(regime, self.unphysical(decades), self.direction())

    def on_separatrix(self):
        k = self.rng.integers(len(self.separatrices))
        moments, p, q = self.separatrices[0 if self.rng.uniform() < 0.3 else k]
        middle = self.direction()[0] * np.hypot(p, q)
        omega = [self.sign() * p, middle, self.sign() * q]
        order = self.rng.permutation(3)
        scale = 2.0 ** self.rng.integers(-6, 4)
        moments = np.array(moments) * 2.0 ** self.rng.integers(-3, 4)
        return (
            moments[order],
            scale * np.array(omega)[order],
            int(np.argmin(moments[order])),
        )

    def separatrix(self):
        for _ in range(60):
            moments, omega, _ = self.on_separatrix()
            assert excess(moments.tolist(), omega.tolist()) == 0
            self.add("separatrix", moments, omega, unstable=True)
        for level in NEAR:
            for _ in range(12):
                moments, omega, axis = self.on_separatrix()
                omega[axis] *= 1 + self.sign() * level
                assert excess(moments.tolist(), omega.tolist()) != 0
                self.add("near separatrix", moments, omega, level, unstable=True)

    def symmetric(self):
        for _ in range(54):
            a, b = np.sort(10 ** self.rng.uniform(-0.5, 0.5, 2))
            self.add("oblate", self.rng.permutation([a, a, b]), self.direction())
            self.add("prolate", self.rng.permutation([a, b, b]), self.direction())
            self.add("sphere", [a, a, a], self.direction())
        for level in NEAR:
            for _ in range(10):
                a, b = 10 ** self.rng.uniform(-0.5, 0.5, 2)
                moments = self.rng.permutation([a, a * (1 + self.sign() * level), b])
                self.add("nearly symmetric", moments, self.direction(), level)
                moments = a * (1 + level * self.rng.uniform(-1, 1, 3))
                self.add("nearly sphere", moments, self.direction(), level)

    def spin(self):
        for rank, name in enumerate(("smallest", "middle", "largest")):
            for _ in range(50):
                moments = self.rng.permutation(self.physical())
                axis = np.argsort(moments)[rank]
                omega = np.zeros(3)
                omega[axis] = self.direction()[0]
                self.add(f"spin, {name}", moments, omega)
                moments = self.rng.permutation(self.physical())
                axis = np.argsort(moments)[rank]
                omega = self.direction()
                omega[np.arange(3) != axis] *= 1e-8
                self.add(f"near spin, {name}", moments, omega, 1e-8, unstable=rank == 1)
        for _ in range(50):
            moments = self.rng.permutation(self.physical())
            self.add("rest", moments, np.zeros(3))
            self.add("omega x 1e-160", moments, 1e-160 * self.direction())

    def tensors(self):
        for k in range(60):
            moments = (
                self.physical() if k % 2 else self.unphysical(self.rng.uniform(0.1, 3))
            )
            rotation, _ = np.linalg.qr(self.rng.normal(size=(3, 3)))
            tensor = rotation @ np.diag(moments) @ rotation.T
            self.add("tensor", (tensor + tensor.T) / 2, self.direction())
        for k in range(
            10
        ):  # exactly symmetric bodies, about an axis of small whole numbers
            axis = self.rng.integers(-3, 4, 3) + np.array([0.5, 0, 0])
            outer = np.outer(axis, axis)
            body = (
                4 * np.eye(3) + outer
                if k % 2
                else (1 + axis @ axis) * np.eye(3) - outer
            )
            self.add("tensor", body, self.direction())


def draw():
    """All cases: tuples (regime, level, inertia, attitude, omega, time)."""
    cases = Cases(20240)
    cases.generic()
    cases.separatrix()
    cases.symmetric()
    cases.spin()
    cases.tensors()
    return cases.rows


def split(values):
    """The nearest doubles, and the rest."""
    high = [float(v) for v in values]
    with mp.workdps(60):
        return high, [float(v - h) for v, h in zip(values, high, strict=True)]


def main():
    rows = draw()
    regime, level, inertia, attitude, omega, time = zip(*rows, strict=True)
    attitudes, omegas = [], []
    for _, _, body, q, w, t in rows:
        ((q_out, w_out),) = free_motion(body, q, w, [t])
        attitudes.append(split(q_out))
        omegas.append(split(w_out))
    attitudes, omegas = np.array(attitudes), np.array(omegas)
    full = [i.ndim == 2 for i in inertia]
    np.savez_compressed(
        HERE / "free_rotation.npz",
        regime=np.array(regime),
        level=np.array(level),
        inertia=np.array(
            [np.full(3, np.nan) if f else i for f, i in zip(full, inertia, strict=True)]
        ),
        tensor=np.array(
            [i if f else np.diag(i) for f, i in zip(full, inertia, strict=True)]
        ),
        attitude=np.array(attitude),
        omega=np.array(omega),
        time=np.array(time),
        attitude_out=attitudes[:, 0],
        attitude_low=attitudes[:, 1],
        omega_out=omegas[:, 0],
        omega_low=omegas[:, 1],
    )


if __name__ == "__main__":
    main()
