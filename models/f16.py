"""Wing of an F-16 (ground vibration test): six modes, and the bolted connection of wing and payload."""

import casadi as ca

import gbid

MODES = ((3.5, 0.56, 0.6, 0.56), (4.0, 0.6, 0.6, 0.56), (5.2, 0.43, 0.67, 0.57), (6.62, 0.33, 0.51, 0.54))
MODES += ((7.36, 0.88, 1.7, 1.64), (9.2, 0.45, 1.56, 1.35))
"""Start values: frequency [Hz], and shape at the shaker, the wing and the payload; from a linear model of level 1."""
SCALE = 1e-4
"""Scale [m] of the motion in the connection."""
SPEED = 50.0
"""Scale [1/s] between velocity and displacement in the connection."""


def wing(name, *more):
    """Return modes between the voltage of the shaker and three accelerations, with the connection: k and g.

    The shaker drives each mode by its shape at the shaker. The force of the connection acts on wing and payload in
    opposite directions. It is the part that grows with the square of the motion: k with its displacement, g with its
    velocity.
    """
    modes = range(len(MODES))

    def accelerations(x, u, p):
        """Return the angular frequencies, the motion and velocity in the connection, and the modal accelerations."""
        w = [2 * ca.pi * p[f"f_{i}"] for i in modes]
        across = [p[f"q_{i}"] - p[f"r_{i}"] for i in modes]
        z = sum(across[i] * x[2 * i] / w[i] ** 2 for i in modes) / SCALE
        v = sum(across[i] * x[2 * i + 1] / w[i] for i in modes) / (SCALE * SPEED)
        force = (p.k * z + p.g * v) * ca.sqrt(z**2 + v**2 + 0.01) if "k" in more else 0.0
        return w, [-x[2 * i] - 2 * p[f"z_{i}"] * x[2 * i + 1] - p[f"p_{i}"] * u[0] - across[i] * force for i in modes]

    def dynamics(x, u, p):
        """Return derivatives; the states of a mode are its coordinate times w^2, and its velocity times w."""
        w, acceleration = accelerations(x, u, p)
        return [each for i in modes for each in (w[i] * x[2 * i + 1], w[i] * acceleration[i])]

    def output(x, u, p):
        """Return the accelerations of shaker, wing and payload; faster modes follow the voltage."""
        modal = accelerations(x, u, p)[1]
        return [sum(p[f"{row}_{i}"] * modal[i] for i in modes) + p[f"d_{row}"] * u[0] for row in "pqr"]

    shape, parameters = "(m/s^2/V)^0.5", []
    for i, (frequency, *shapes) in enumerate(MODES):
        parameters += [gbid.Parameter(f"f_{i}", frequency, lower=0.5, unit="Hz")]
        parameters += [gbid.Parameter(f"z_{i}", 0.008, lower=1e-4, unit="1")]
        parameters += [gbid.Parameter(f"{row}_{i}", x, unit=shape) for row, x in zip("pqr", shapes, strict=True)]
    parameters += [gbid.Parameter(f"d_{row}", 0.0, unit="m/s^2/V") for row in "pqr"]
    parameters += [gbid.Parameter(key, start, unit="V") for key, start in (("k", -0.2), ("g", 0.1)) if key in more]
    return gbid.NonlinearStructure(
        name,
        parameters,
        states=[f"{kind}_{i}" for i in modes for kind in ("coordinate", "velocity")],
        dynamics=dynamics,
        output=output,
        inputs="voltage",
        outputs=["shaker", "wing", "payload"],
        intersample="foh",
        steps=2,
    )


linear = wing("six modes")
structure = wing("six modes, stiffness and damping of the connection", "k", "g")
