"""Write top_motion.npz and top_derivatives.npz: heavy symmetric tops of every kind at
30 digits.

Run as `python tests/data/make_top_motion.py`; it takes about ten minutes. The cases are
drawn with a fixed seed, and the motions come from tests/taylor_reference.py.

Arrays, one row a case: `regime` (name), `level` (how far from the degenerate case the
regime is named after; 0 where that means nothing), `moments` (n, 2; I1 = I2 and I3),
`mgl`, `attitude`, `omega`, `time`, and the state then, `attitude_out` and `omega_out`,
each the nearest double, with `attitude_low` and `omega_low` what is left of it: value =
out + low to 30 digits of the state's units (for omega, `fastest` below). The sign of
the attitude is continuous in time.
"""

import itertools
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from make_free_rotation import split  # noqa: E402
from reference import heavy_body  # noqa: E402
from taylor_reference import taylor_top  # noqa: E402

BITS = 152
STABLE, UNSTABLE = 200.0, 60.0  # longest times, as multiples of 1 / fastest


def fastest(i1, i3, mgl, omega):
    return max(*np.abs(omega), i3 / i1 * abs(omega[2]), np.sqrt(abs(mgl) / i1))


def threshold(i1, i3, mgl):
    """omega3 above which a top sleeps."""
    return 2 * np.sqrt(abs(mgl) * i1) / i3


class Cases:
    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.rows = []

    # Draws

    def sign(self):
        return self.rng.choice([-1.0, 1.0])

    def power(self, low, high):
        return 10 ** self.rng.uniform(low, high)

    def top(self, ratio=None):
        """I1, I3, mgl."""
        i1 = self.power(-0.5, 0.5)
        i3 = i1 * (self.rng.uniform(0.2, 1.9) if ratio is None else ratio)
        return i1, i3, i1 * self.power(-0.3, 0.3)

    def omega(self, top):
        return self.rng.normal(size=3) * np.sqrt(top[2] / top[0])

    def tilted(self, cos, sin):
        """An attitude with these cosine and sine of half the tilt;
        any turn about each vertical."""
        a, b = self.rng.uniform(0, 2 * np.pi, 2)
        return np.array(
            [cos * np.cos(a), sin * np.cos(b), sin * np.sin(b), cos * np.sin(a)]
        )

    def tilt(self, angle):
        return self.tilted(np.cos(angle / 2), np.sin(angle / 2))

    def anywhere(self):
        return self.tilt(np.arccos(self.rng.uniform(-1, 1)))

    def upright(self):
        return self.tilted(1, 0)

    def upside_down(self):
        return self.tilted(0, 1)

    def duration(self, shortest, longest):
        if self.rng.uniform() < 0.02:
            return 0.0
        sign = -1 if self.rng.uniform() < 0.3 else 1
        return sign * self.power(np.log10(shortest), np.log10(longest))

    def add(
        self,
        regime,
        top,
        attitude,
        omega,
        level=0.0,
        unstable=False,
        span=None,
        shortest=0.1,
        bits=BITS,
    ):
        """Add a case; `span` is the time times `fastest`, else drawn."""
        attitude, omega = attitude + 0.0, np.asarray(omega, float) + 0.0  # no -0.0
        if span is None:
            span = self.duration(shortest, UNSTABLE if unstable else STABLE)
        rate = fastest(*top, omega)
        time = span / rate if rate else span
        bits = bits + (int(2.2 * abs(span)) if unstable else 0)
        self.rows.append((regime, level, top[:2], top[2], attitude, omega, time, bits))

    # Regimes

    def generic(self):
        for k in range(60):
            top = self.top()
            span = 2000.0 * (-1) ** k if k < 4 else None
            self.add(
                "generic nutation", top, self.anywhere(), self.omega(top), span=span
            )
        for _ in range(50):
            i1, i3, mgl = top = self.top()
            self.add("negative mgl", (i1, i3, -mgl), self.anywhere(), self.omega(top))
            top = self.top(self.power(-3, 2))
            self.add("extreme moments", top, self.anywhere(), self.omega(top))
            i1, i3, _ = top = self.top()
            self.add("no gravity", (i1, i3, 0.0), self.anywhere(), self.omega(top))
            for regime, unit in (("slow units", 1e-7), ("fast units", 1e4)):
                i1, i3, mgl = top = self.top()
                omega = unit * self.omega(top)
                self.add(regime, (i1, i3, unit**2 * mgl), self.anywhere(), omega)

    def nutation(self):
        for k in range(50):
            i1, i3, mgl = top = self.top()
            spin = self.sign() * threshold(*top) * self.power(-0.7, 0.8)
            self.add("cusp", top, self.anywhere(), [0, 0, spin])
            omega = self.omega(top)
            omega[2] = self.sign() * self.power(1.5, 3) * np.sqrt(mgl / i1)
            span = 2000.0 * (-1) ** k if k < 2 else None
            self.add("fast spin", top, self.anywhere(), omega, span=span)
        count = 0
        while count < 50:
            i1, i3, mgl = top = self.top()
            attitude, omega = self.anywhere(), self.omega(top) * [1, 1, 3]
            w, x, y, z = attitude
            # The precession changes sign where cos(tilt) = turn, if the nutation
            # reaches it
            height = w * w + z * z - x * x - y * y
            swing = 2 * (omega[0] * (x * z - w * y) + omega[1] * (y * z + w * x))
            turn = height + i1 * swing / (i3 * omega[2])
            if abs(turn) < 1 and i1 * (omega[0] ** 2 + omega[1] ** 2) > 2 * mgl * (
                turn - height
            ):
                self.add("loops", top, attitude, omega)
                count += 1

    def steady(self):
        for k in range(60):
            i1, i3, mgl = top = self.top()
            w, x, y, z = attitude = self.anywhere()
            height = w * w + z * z - x * x - y * y
            spin = self.sign() * threshold(*top)
            if height > 0:
                spin *= np.sqrt(height) * (1 + self.power(-2, 0.5))
            else:
                spin *= self.rng.uniform(0, 2)
            root = np.sqrt((i3 * spin) ** 2 - 4 * i1 * height * mgl)
            slow = 2 * mgl / (i3 * spin + np.sign(spin) * root)
            rate = slow if k % 2 else mgl / (i1 * height * slow)
            omega = [2 * rate * (x * z - w * y), 2 * rate * (y * z + w * x), spin]
            self.add("steady", top, attitude, omega)

    def vertical(self):
        for k in range(50):
            for regime, attitude in (
                ("start upright", self.upright()),
                ("start upside down", self.upside_down()),
            ):
                i1, i3, mgl = top = self.top()
                omega = self.omega(top)
                top = (i1, i3, -mgl if k % 5 == 4 else mgl)
                self.add(regime, top, attitude, omega)
            top = self.top()
            kind = k % 5
            spin = self.sign() * threshold(*top)
            spin *= (
                self.power(0, 0.7),
                self.power(-1, 0),
                1,
                self.rng.uniform(0.95, 1),
                1,
            )[kind]
            if kind == 4:  # at the threshold exactly
                top = (
                    2.0 ** self.rng.integers(-2, 3),
                    1.0,
                    2.0 ** self.rng.integers(-2, 3),
                )
                top = (
                    top[0],
                    top[0] * self.rng.choice([0.25, 0.5, 1]),
                    top[0] * top[2] ** 2,
                )
                spin = self.sign() * 2 * np.sqrt(top[2] * top[0]) / top[1]
            self.add(
                "sleeping", top, self.upright(), [0, 0, spin], unstable=kind in (1, 3)
            )

    def passing(self):
        for k in range(60):
            for regime, attitude in (
                ("through upright", self.upright()),
                ("through upside down", self.upside_down()),
            ):
                i1, _, mgl = top = self.top()
                if k % 4 == 3:  # a planar pendulum, over the top
                    angle = self.rng.uniform(0, 2 * np.pi)
                    attitude = np.array([np.cos(angle), np.sin(angle), 0, 0])
                    energy = mgl * (1 + self.power(-1, 1))
                    omega = [
                        self.sign()
                        * np.sqrt(2 * (energy - mgl * np.cos(2 * angle)) / i1)
                    ]
                    self.add(
                        regime, top, attitude, [*omega, 0, 0], unstable=True, shortest=3
                    )
                    continue
                omega = self.omega(top)
                before = self.rng.uniform(1, 3)
                span = self.duration(before, UNSTABLE)
                if k % 8 == 0:  # ends there
                    span = np.copysign(before, span)
                time = -np.copysign(before, span) / fastest(*top, omega)
                attitude, omega = (
                    np.array([float(v) for v in values])
                    for values in taylor_top(*top, attitude, omega, time)
                )
                if k % 8 == 0:
                    span = -time * fastest(*top, omega)
                self.add(regime, top, attitude, omega, unstable=True, span=span)

    def near_sleeping(self, repeats, longer=0):
        """Over times of 60 and, `longer` times more, 300 to 1500:
        a nutation lasts that long."""
        tilts, signs = (0.5, 1e-2, 1e-4, 1e-6), (-1, 1)
        levels = (1e-3, 1e-8, 1e-12)
        for level, tilt, sign, k in itertools.product(
            levels, tilts, signs, range(repeats + longer)
        ):
            top = self.top()
            spin = self.sign() * threshold(*top) * (1 + sign * level)
            omega = self.omega(top) * min(k, 1) * tilt
            omega[2] = spin
            if k < repeats:
                self.add(
                    "near sleeping spin",
                    top,
                    self.tilt(tilt),
                    omega,
                    level,
                    unstable=True,
                )
                continue
            span = self.sign() * self.power(2.5, 3.2)
            self.add(
                "near sleeping spin",
                top,
                self.tilt(tilt),
                omega,
                level,
                span=span,
                bits=412,
            )

    def pendulum(self):
        for k in range(60):
            i1, _, mgl = top = self.top()
            if k % 3 == 0:
                self.add("pendulum", top, self.anywhere(), self.omega(top) * [1, 1, 0])
                continue
            angle = self.rng.uniform(0, 2 * np.pi)
            attitude = np.array([np.cos(angle), np.sin(angle), 0, 0])
            if k % 3 == 1:
                self.add("pendulum", top, attitude, self.omega(top) * [1, 0, 0])
                continue
            level = 10.0 ** -self.rng.integers(3, 13)
            energy = mgl * (1 + self.sign() * level)
            while energy <= mgl * np.cos(2 * angle):
                angle = self.rng.uniform(0, 2 * np.pi)
                attitude = np.array([np.cos(angle), np.sin(angle), 0, 0])
            omega = self.sign() * np.sqrt(2 * (energy - mgl * np.cos(2 * angle)) / i1)
            self.add("pendulum", top, attitude, [omega, 0, 0], level, unstable=True)

    def hanging(self):
        for k in range(60):
            i1, i3, mgl = top = self.top()
            spin = self.omega(top) * [0, 0, k % 3 > 0]
            if k % 2:
                top = (i1, i3, -mgl)
            if k < 20:
                self.add(
                    "hanging",
                    top,
                    self.upright() if k % 2 else self.upside_down(),
                    spin,
                )
                continue
            level = 10.0 ** -self.rng.integers(3, 9)
            cos, sin = np.cos(level / 2), np.sin(level / 2)
            attitude = self.tilted(cos, sin) if k % 2 else self.tilted(sin, cos)
            omega = spin + level * self.rng.normal(size=3) * [1, 1, 0] * (k % 4 > 1)
            self.add("hanging", top, attitude, omega, level)

    def rest(self):
        for k in range(50):
            i1, i3, mgl = self.top()
            mgl = 0.0 if k % 5 == 4 else -mgl if k % 5 == 3 else mgl
            self.add("rest", (i1, i3, mgl), self.anywhere(), np.zeros(3))


def draw():
    """All cases: tuples (regime, level, moments, mgl, attitude, omega, time, bits)."""
    cases = Cases(20241)
    cases.generic()
    cases.nutation()
    cases.steady()
    cases.vertical()
    cases.passing()
    cases.near_sleeping(3)
    cases.pendulum()
    cases.hanging()
    cases.rest()
    cases.near_sleeping(2, longer=2)
    return cases.rows


# --- Derivatives
# --------------------------------------------------------------------------------

SCALES = ("slow units", "fast units")


def derivatives(rows):
    """Some tops of every kind in units in which their rates are below 1,
    and their Jacobians.

    By variational equations in 80-bit Taylor series (tests/reference.py): the last
    state with respect to attitude (4, its norm free), omega (3), I1, I3 and mgl. Over
    200 only what is stable: exp(lambda t) of the rest is beyond 80 bits.
    """
    regimes, inputs, durations = [], [], []
    for regime in dict.fromkeys(row[0] for row in rows if row[0] not in SCALES):
        own = [row for row in rows if row[0] == regime]
        picked = [own[k] for k in np.linspace(0, len(own) - 1, 8).astype(int)]
        for k, (_, _, (i1, i3), mgl, attitude, omega, _, bits) in enumerate(picked):
            unit = 2.0 ** np.ceil(np.log2(fastest(i1, i3, mgl, omega) or 1.0))
            x = np.array(
                [
                    *attitude / np.linalg.norm(attitude),
                    *omega / unit,
                    i1,
                    i3,
                    mgl / unit**2,
                ]
            )
            inputs.append(x)
            regimes.append(regime)
            durations.append(
                (20.0, -20.0, 20.0, -200.0 if bits == BITS else -20.0)[k % 4]
            )
    inputs, durations = np.array(inputs), np.array(durations)
    states, jacobians = np.zeros((len(inputs), 7)), np.zeros((len(inputs), 7, 10))
    for duration in np.unique(durations):
        chosen = durations == duration
        q, w, (i1, i3, mgl) = (
            inputs[chosen, :4],
            inputs[chosen, 4:7],
            inputs[chosen, 7:].T,
        )
        lever = np.stack([0 * mgl, 0 * mgl, mgl], axis=1)
        state, full = heavy_body(np.stack([i1, i1, i3], axis=1), q, w, duration, lever)
        columns = [
            full[:, :, :7],
            (full[:, :, 7] + full[:, :, 8])[:, :, None],
            full[:, :, [9, 12]],
        ]
        states[chosen] = state
        jacobians[chosen] = np.concatenate(columns, axis=2)
    names = "regime", "inputs", "duration", "state", "jacobian"
    found = np.array(regimes), inputs, durations, states, jacobians
    return dict(zip(names, found, strict=True))


def main():
    rows = draw()
    regime, level, moments, mgl, attitude, omega, time, _ = zip(*rows, strict=True)
    attitudes, omegas = [], []
    for _, _, (i1, i3), weight, q, w, t, bits in rows:
        q_out, w_out = taylor_top(i1, i3, weight, q, w, t, bits)
        attitudes.append(split(q_out))
        omegas.append(split(w_out))
    attitudes, omegas = np.array(attitudes), np.array(omegas)
    np.savez_compressed(
        HERE / "top_motion.npz",
        regime=np.array(regime),
        level=np.array(level),
        moments=np.array(moments),
        mgl=np.array(mgl),
        attitude=np.array(attitude),
        omega=np.array(omega),
        time=np.array(time),
        attitude_out=attitudes[:, 0],
        attitude_low=attitudes[:, 1],
        omega_out=omegas[:, 0],
        omega_low=omegas[:, 1],
    )
    np.savez_compressed(HERE / "top_derivatives.npz", **derivatives(rows))


if __name__ == "__main__":
    main()
