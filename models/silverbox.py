"""The Silverbox, an electronic oscillator of Duffing's kind: a spring that stiffens, damping by position."""

import gbid


def oscillator(name, *more):
    """Return the oscillator with a cubic spring, and with more parameters: k_4, k_5, d_1, d_2."""

    def position(x, u, p):
        """Return the position [V]; b_2, with b_1, lets the input between its samples differ from a straight line."""
        return x[0] + p.b_2 * u[0]

    def dynamics(x, u, p):
        """Return the derivatives of the states; the second one is the velocity [V/s]."""
        q, v = position(x, u, p), x[1]
        spring = p.k_0 + p.k * q + p.k_2 * q**2 + p.k_3 * q**3
        damping = p.d
        if "k_5" in more:
            spring += p.k_4 * q**4 + p.k_5 * q**5
        if "d_2" in more:
            damping += p.d_1 * q + p.d_2 * q**2
        return [v + p.b_1 * u[0], p.b * u[0] - damping * v - spring]

    starts = {"k": 2e5, "d": 30.0, "b": 2e5, "b_1": 0.0, "b_2": 0.0, "k_0": 0.0, "k_2": 0.0, "k_3": 0.0}
    units = {"k": "1/s^2", "d": "1/s", "b": "1/s^2", "b_1": "1/s", "b_2": "1", "k_0": "V/s^2", "k_2": "1/(V s^2)"}
    units |= {"k_3": "1/(V^2 s^2)", "k_4": "1/(V^3 s^2)", "k_5": "1/(V^4 s^2)", "d_1": "1/(V s)", "d_2": "1/(V^2 s)"}
    return gbid.NonlinearStructure(
        name,
        [gbid.Parameter(key, starts.get(key, 0.0), unit=units[key]) for key in (*starts, *more)],
        states=["position", "velocity"],
        dynamics=dynamics,
        output=position,
        intersample="foh",
    )


cubic = oscillator("cubic spring")
fifth = oscillator("spring of fifth degree", "k_4", "k_5")
structure = oscillator("cubic spring, damping by position", "d_1", "d_2")
both = oscillator("spring of fifth degree, damping by position", "k_4", "k_5", "d_1", "d_2")
