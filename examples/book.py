"""The picture of the README: every free motion of a thrown book, and its flip. Writes one png."""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr

BLUE, ORANGE, GREY = "#2b6ca3", "#d9822b", "#444444"


def polhodes(moments):
    """Momentum directions along polhodes about the first and the third axis, and the separatrix."""
    slope = jr.free.separatrix(moments).momentum_angle

    def curve(direction):
        omega = direction / moments
        momentum = jr.free.polhode(moments, omega, 241) * moments
        return momentum / jnp.linalg.norm(momentum, axis=1, keepdims=True)

    def start(angle):
        return jnp.stack([jnp.cos(angle), 0.0 * angle, jnp.sin(angle)])

    below = jax.vmap(lambda a: curve(start(a)))(slope * jnp.array([0.12, 0.35, 0.6, 0.82, 0.95]))
    above = slope + (jnp.pi / 2 - slope) * jnp.array([0.05, 0.18, 0.4, 0.65, 0.88])
    above = jax.vmap(lambda a: curve(start(a)))(above)
    turn = jnp.linspace(0.0, 2 * jnp.pi, 241)
    edge = jnp.stack(
        [jnp.cos(slope) * jnp.cos(turn), jnp.sin(turn), jnp.sin(slope) * jnp.cos(turn)], axis=1
    )
    return below, above, edge


def draw_sphere(axes, moments):
    """Polhodes on the sphere of the angular momentum, seen from in front."""
    below, above, edge = (np.asarray(x) for x in polhodes(moments))
    eye = np.array([0.62, 0.55, 0.56])
    eye /= np.linalg.norm(eye)
    axes.view_init(elev=np.degrees(np.arcsin(eye[2])), azim=np.degrees(np.arctan2(eye[1], eye[0])))

    def draw(curve, colour, width):
        for sign in (1, -1):
            line = sign * curve
            for part, alpha in ((line @ eye >= 0, 1.0), (line @ eye < 0, 0.18)):
                shown = np.where(part[:, None], line, np.nan)
                axes.plot(*shown.T, color=colour, lw=width, alpha=alpha, solid_capstyle="round")

    for curves, colour in ((below, BLUE), (above, ORANGE)):
        for curve in curves:
            draw(curve, colour, 1.3)
    for flip in (1, -1):
        draw(edge * np.array([1, 1, flip]), GREY, 2.0)
    for direction, name in zip(np.eye(3), "123", strict=True):
        axes.plot(*np.outer([1.0, 1.25], direction).T, color="black", lw=0.8)
        axes.text(*(1.36 * direction), name, ha="center", va="center", fontsize=10)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
    axes.set_box_aspect((1, 1, 1), zoom=1.5)
    axes.set_proj_type("ortho")
    axes.set_axis_off()


def draw_flips(figure, grid, moments):
    """The same spin about each of the three axes, a little off: only the middle one flips."""
    ts = jnp.linspace(0.0, 10.0, 1001)
    identity = jnp.array([1.0, 0.0, 0.0, 0.0])
    names = (
        "thrown about its long side",
        "about its short side: it flips",
        "about its face's normal",
    )
    first = None
    for axis, (name, colour) in enumerate(zip(names, (BLUE, GREY, ORANGE), strict=True)):
        omega = (9.0 * jnp.eye(3)[axis]).at[(axis + 1) % 3].add(0.01)
        motion = jr.free_rotation(moments, jr.State(identity, omega), ts)
        panel = figure.add_subplot(grid[axis, 1], sharex=first)
        first = panel if first is None else first
        panel.plot(ts, motion.omega[:, axis], color=colour, lw=1.6)
        panel.set_ylim(-11, 11)
        panel.set_yticks([-9, 0, 9])
        panel.set_title(name, loc="left", fontsize=9, pad=3)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelbottom=axis == 2, labelsize=8)
        panel.set_ylabel(rf"$\omega_{axis + 1}$ [rad/s]", fontsize=8)
    panel.set_xlabel("time [s]", fontsize=8)


def main(path):
    """Draw both and write the file."""
    import matplotlib.pyplot as plt

    jax.config.update("jax_enable_x64", True)
    book = jr.solids.box(0.6, jnp.array([0.24, 0.17, 0.03]))
    moments = jnp.diagonal(book.inertia)  # long side, short side, normal
    figure = plt.figure(figsize=(9.0, 4.4))
    grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1), hspace=0.5, wspace=0.08)
    draw_sphere(figure.add_subplot(grid[:, 0], projection="3d"), moments)
    draw_flips(figure, grid, moments)
    figure.subplots_adjust(left=0.0, right=0.98, top=0.94, bottom=0.11)
    figure.savefig(path, dpi=130)
    print(f"moments {np.asarray(moments).round(6)} kg m^2, written to {path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "book.png")
