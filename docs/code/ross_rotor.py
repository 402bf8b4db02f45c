"""Rotor of Friswell et al. (2010), Example 5.9.1, and a recording simulated with its whole finite-element model."""

import numpy as np
from scipy.linalg import expm

import gbid
from gbid.export.ross import ross_package

ross = ross_package("this page")  # like `import ross`, without the messages of its dependencies
steel = ross.Material(name="steel", rho=7810, E=211e9, G_s=81.2e9)
sensors = [(0, "x"), (0, "y"), (6, "x"), (6, "y")]
actuators = [(2, "x"), (2, "y")]
true = {
    "left": {
        "kxx": 1.0e6,
        "kxy": 1.5e5,
        "kyx": -1.2e5,
        "kyy": 0.8e6,
        "cxx": 900.0,
        "cxy": 40.0,
        "cyx": -30.0,
        "cyy": 1100.0,
    },
    "right": {
        "kxx": 1.3e6,
        "kxy": -0.8e5,
        "kyx": 1.0e5,
        "kyy": 1.1e6,
        "cxx": 1500.0,
        "cxy": -50.0,
        "cyx": 60.0,
        "cyy": 1300.0,
    },
}
assumed = {
    "left": {"kxx": 0.8e6, "kyy": 0.64e6, "cxx": 630.0, "cyy": 770.0},
    "right": {"kxx": 1.63e6, "kyy": 1.38e6, "cxx": 1950.0, "cyy": 1690.0},
}


def rotor(left, right):
    """The rotor with the coefficients of both bearings, as keywords of ross.BearingElement."""
    shaft = [ross.ShaftElement(0.25, 0.0, 0.05, material=steel) for _ in range(6)]
    discs = [
        ross.DiskElement.from_geometry(n=n, material=steel, width=0.07, i_d=0.05, o_d=diameter)
        for n, diameter in ((2, 0.28), (4, 0.35))
    ]
    bearings = [ross.BearingElement(n=0, tag="left", **left), ross.BearingElement(n=6, tag="right", **right)]
    return ross.Rotor(shaft, discs, bearings)


def lateral_matrix(machine, speed_rpm):
    """State matrix of the lateral motion, and its degrees of freedom."""
    lateral = [i for i in range(machine.ndof) if i % machine.number_dof in (0, 1, 3, 4)]
    both = [*lateral, *(machine.ndof + i for i in lateral)]
    return machine.A(speed_rpm * np.pi / 30)[np.ix_(both, both)], lateral


def frequencies(A):
    """The six lowest natural frequencies [rad/s] of a state matrix."""
    return np.sort(np.abs(np.linalg.eigvals(A)))[::2][:6]


def simulated(machine, speed_rpm, step=1e-3, n=2000):
    """Recording of random forces of 20 N at the left disc, and of both bearings' positions with 0.1 um of noise."""
    random = np.random.default_rng(0)
    force = 20.0 * np.repeat(random.choice([-1.0, 1.0], (n // 4, 2)), 4, axis=0)
    A, lateral = lateral_matrix(machine, speed_rpm)
    size = len(lateral)
    places = np.zeros((size, 2))
    for i, (node, axis) in enumerate(actuators):
        places[lateral.index(machine.number_dof * node + "xy".index(axis)), i] = 1.0
    B = np.vstack([np.zeros((size, 2)), np.linalg.solve(machine.M(0)[np.ix_(lateral, lateral)], places)])
    held = expm(step * np.block([[A, B], [np.zeros((2, 2 * size + 2))]]))
    rows = [lateral.index(machine.number_dof * node + "xy".index(axis)) for node, axis in sensors]
    x, p = np.zeros(2 * size), np.zeros((n, 4))
    for k in range(n):
        p[k] = x[rows]
        x = held[: 2 * size, : 2 * size] @ x + held[: 2 * size, 2 * size :] @ force[k]
    return gbid.Recording({"f": force, "p": p + 1e-7 * random.standard_normal(p.shape)}, step, name="two bearings")
