"""Known flows: what the equations of motion and the given parameters demand of them."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

from lfpiv_cli.synthetic import flows
from lfpiv_cli.synthetic.flows import advect, pipe, random_modes, rigid_rotation, square_duct, taylor_green, vortex_ring

WIDTH = 10.0
MEAN = 0.1082
CENTRE = (0.3, -0.2, -0.4655)

EXAMPLES = {
    "square_duct": square_duct(WIDTH, MEAN, CENTRE),
    "pipe": pipe(WIDTH / 2, MEAN, CENTRE, "y"),
    "rigid_rotation": rigid_rotation((1.0, -2.0, 3.0), CENTRE, (0.1, 0.0, 0.0)),
    "taylor_green": taylor_green(0.05, 8.0, CENTRE),
    "shear": flows.shear(4.0, "z", "x", CENTRE),
    "uniform": flows.uniform((0.1, -0.02, 0.03)),
    "random_modes": random_modes(0.05, shortest_mm=8.0, centre_mm=CENTRE),
    "abc": flows.abc((0.05, 0.03, -0.02), 8.0, CENTRE),
    "vortex_ring": vortex_ring(0.05, 3.0, 2.0, "y", CENTRE),
    "source": flows.source(40.0, 2.0, CENTRE, (0.0, 0.01, 0.0)),
}
CELLULAR = taylor_green(0.05, 8.0, CENTRE, "yz", third_amplitude_m_s=0.03)
SOLENOIDAL = {name: flow for name, flow in EXAMPLES.items() if name != "source"} | {"cellular": CELLULAR}
WITH_PRESSURE = {
    "taylor_green": taylor_green(0.05, 8.0, CENTRE, "yz", velocity_m_s=(0.2, 0.0, 0.0)),
    "rigid_rotation": EXAMPLES["rigid_rotation"],
    "abc": EXAMPLES["abc"],
}


def section(n, half):
    """Return midpoints of an n x n division of the duct's section, as points (n*n, 3) about the centre."""
    line = (np.arange(n) + 0.5) / n * 2 * half - half
    y, z = np.meshgrid(line, line)
    return np.stack([np.zeros(n * n), y.ravel(), z.ravel()], axis=1) + CENTRE


def gradient(flow, points, step):
    """Return d v_i / d r_j by central differences, (n, 3, 3), in 1/s."""
    columns = [(flow(points + step * e) - flow(points - step * e)) / (2e-3 * step) for e in np.eye(3)]
    return np.stack(columns, axis=2)


def test_registry_holds_every_flow_and_pressure_where_it_has_a_closed_form():
    assert set(flows.FLOWS) == set(EXAMPLES)
    for name, flow in EXAMPLES.items():
        assert flow(np.zeros((4, 3))).shape == (4, 3), name
    moved = {"velocity_m_s": (0.0, 0.0, 0.1)}
    assert taylor_green(0.05, 8.0, **moved).pressure is None
    assert flows.abc((0.1, 0.1, 0.1), 8.0, **moved).pressure is None
    assert CELLULAR.pressure is None


@pytest.mark.parametrize("name", SOLENOIDAL)
def test_flows_are_divergence_free(name, rng):
    points = CENTRE + rng.uniform(-4.0, 4.0, (50, 3))
    # central differences of smooth functions with a step of 1e-3 of the scale: 1e-6 relative, rounding 1e-11
    trace = np.trace(gradient(SOLENOIDAL[name], points, 1e-3), axis1=1, axis2=2)
    assert np.abs(trace).max() < 1e-5
    # those that it tells of itself are right to rounding
    assert np.abs(np.trace(SOLENOIDAL[name].gradient(points), axis1=1, axis2=2)).max() < 1e-9


@pytest.mark.parametrize("name", [*EXAMPLES, "cellular"])
def test_gradients_are_those_of_the_velocities(name, rng):
    flow = CELLULAR if name == "cellular" else EXAMPLES[name]
    # beyond the duct's walls, too, but not across them
    points = CENTRE + np.concatenate([rng.uniform(-4.0, 4.0, (40, 3)), rng.uniform(6.0, 8.0, (5, 3))])
    # up to 60 per second, of central differences 1e-6 of it
    assert flow.gradient(points) == pytest.approx(gradient(flow, points, 1e-3), abs=1e-4)


@pytest.mark.parametrize("name", WITH_PRESSURE)
def test_pressure_accelerates_the_fluid_as_euler_demands(name, rng):
    flow, points, density, step = WITH_PRESSURE[name], CENTRE + rng.uniform(-4.0, 4.0, (30, 3)), 998.0, 1e-3
    there, back = ([flow.pressure(points + sign * step * e, density) for e in np.eye(3)] for sign in (1.0, -1.0))
    acceleration = np.einsum("nij,nj->ni", flow.gradient(points), flow(points))
    # central differences over 2 um, in Pa/m; accelerations reach 1 m/s^2
    assert np.subtract(there, back).T / (2e-3 * step) == pytest.approx(-density * acceleration, abs=1e-2)
    assert np.abs(acceleration).max() > 0.05


def test_duct_has_the_given_mean_and_a_square_s_peak():
    u = EXAMPLES["square_duct"](section(200, WIDTH / 2))[:, 0]
    assert u.mean() == pytest.approx(MEAN, rel=5e-5)  # midpoint rule with 200 cells: 1/(2 n^2) and its factor
    peak = EXAMPLES["square_duct"](np.array([CENTRE]))[0, 0]
    assert peak / MEAN == pytest.approx(2.0963, abs=5e-5)  # tabulated to four decimals
    # at the axis 2.0963 * 0.1082 m/s * 1.8 ms = 0.40827 mm, the pair's four voxels of 0.1 mm
    moved = advect(EXAMPLES["square_duct"], [CENTRE], 1.8e-3) - CENTRE
    assert moved[0] == pytest.approx([0.40827, 0, 0], abs=1e-5)


def test_duct_solves_poisson_equation(rng):
    flow, step = EXAMPLES["square_duct"], 0.02
    points = CENTRE + rng.uniform(-4.5, 4.5, (100, 3))
    around = [step * np.array(e) for e in [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]]
    laplacian = (sum(flow(points + e)[:, 0] for e in around) - 4 * flow(points)[:, 0]) / step**2
    # -u'' / mean is the constant that the peak-free flux integral fixes: 28.454/D^2 for a square (f Re = 56.908)
    assert laplacian * WIDTH**2 / MEAN == pytest.approx(np.full(100, -28.454), rel=1e-3)


def test_duct_is_symmetric_and_vanishes_on_and_beyond_the_walls():
    half = WIDTH / 2
    edge = np.array([(0, half, 1.0), (0, -half, 0), (0, 2.0, half), (0, 1.0, -half), (0, 6.0, 0), (0, 0, -5.1)])
    assert np.all(np.abs(EXAMPLES["square_duct"](edge + CENTRE)) < 1e-15)
    just_inside = np.array([(0, 1.0, half - 1e-9), (0, half - 1e-9, 1.0)]) + CENTRE
    assert np.abs(EXAMPLES["square_duct"](just_inside)).max() < 1e-5 * MEAN
    # Duct is symmetric.
    flow = EXAMPLES["square_duct"]
    points = section(9, 4.9) - CENTRE
    u = flow(points + CENTRE)[:, 0]
    for turned in (points * (1, -1, 1), points * (1, 1, -1), points[:, [0, 2, 1]]):
        assert flow(turned + CENTRE)[:, 0] == pytest.approx(u, abs=1e-5 * MEAN)


def test_ducts_and_pipes_along_y_are_those_along_x_with_axes_exchanged_or_turned(rng):
    points = rng.uniform(-4.0, 4.0, (20, 3))
    along_x = square_duct(WIDTH, MEAN)(points)
    along_y = square_duct(WIDTH, MEAN, axis="y")(points[:, [1, 0, 2]])
    assert np.array_equal(along_y[:, [1, 0, 2]], along_x)
    points = rng.uniform(-5.0, 5.0, (20, 3))
    along_y = pipe(WIDTH / 2, MEAN, axis="y")(points[:, [1, 0, 2]])
    assert np.array_equal(along_y[:, [1, 0, 2]], pipe(WIDTH / 2, MEAN)(points))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.uniform(-3.0, 3.0, (20, 3))
    straight, tilted = pipe(WIDTH / 2, MEAN), pipe(WIDTH / 2, MEAN, axis=tuple(3.0 * turn[:, 0]))
    assert tilted(points @ turn.T) == pytest.approx(straight(points) @ turn.T, abs=1e-12)
    assert tilted.gradient(points @ turn.T) == pytest.approx(turn @ straight.gradient(points) @ turn.T, abs=1e-9)


def test_pipe_has_the_given_mean_solves_poisson_equation_and_vanishes_outside(rng):
    line = (np.arange(400) + 0.5) / 400 * WIDTH - WIDTH / 2
    x, z = np.meshgrid(line, line)
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1) + CENTRE
    u = EXAMPLES["pipe"](points)[:, 1]
    # a circle of 400 cells across: those that it cuts are slow
    assert u.sum() / x.size == pytest.approx(MEAN * np.pi / 4, rel=1e-5)
    assert u.max() == pytest.approx(2.0 * MEAN, rel=1e-4)
    flow, step = EXAMPLES["pipe"], 0.02
    points = CENTRE + rng.uniform(-3.4, 3.4, (100, 3))
    around = [step * np.array(e) for e in [(1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1)]]
    laplacian = (sum(flow(points + e)[:, 1] for e in around) - 4 * flow(points)[:, 1]) / step**2
    # f Re = 64: u'' = -32 / D^2 of the mean; a parabola's differences are exact but for rounding, 1e-13
    assert laplacian * WIDTH**2 / MEAN == pytest.approx(np.full(100, -32.0), rel=1e-8)
    beyond = np.array([(5.0, 0.0, 0.0), (3.0, 9.0, 4.1), (-6.0, 1.0, 0.0)]) + CENTRE
    assert np.all(np.abs(flow(beyond)) < 1e-15)
    assert not flow.gradient(beyond[1:]).any()


def test_rotation_shear_and_taylor_green_vortices_by_hand():
    # omega = 3 rad/s about z: the point 1 mm along +x of the centre moves along +y with 3 mm/s
    flow = rigid_rotation((0.0, 0.0, 3.0), CENTRE, (0.1, 0.0, 0.0))
    assert flow(np.array([CENTRE, CENTRE + np.eye(3)[0]])) == pytest.approx(np.array([[0.1, 0, 0], [0.1, 3e-3, 0]]))
    # a quarter wavelength along x: v_x = A sin(pi/2) = A; an eighth along both: A/2 and -A/2
    flow = taylor_green(0.05, 8.0, CENTRE, velocity_m_s=(0.0, 0.01, 0.0))
    points = np.array([(2.0, 5.0, 0.0), (1.0, 0.0, 1.0)]) + CENTRE
    assert flow(points) == pytest.approx(np.array([[0.05, 0.01, 0], [0.025, 0.01, -0.025]]), abs=1e-15)
    # 4 per second over 2 mm: 8 mm/s along z
    assert flows.shear(4.0, "z", "x", CENTRE)(np.array([(2.0, 1.0, 1.0)]) + CENTRE) == pytest.approx(
        np.array([[0, 0, 8e-3]])
    )
    # an eighth along all axes: each amplitude / 2^(3/2), that of z, the second axis, less the sum of the others
    expected = np.array([0.03, 0.05, -0.08]) / np.sqrt(8.0)
    assert CELLULAR(np.array([(1.0, 1.0, 1.0)]) + CENTRE)[0] == pytest.approx(expected, abs=1e-15)
    still = np.array([(1.0, 2.0, 2.0), (0.0, 0.0, 0.0)]) + CENTRE
    assert CELLULAR(still) == pytest.approx(np.zeros((2, 3)), abs=1e-15)


def test_abc_by_hand_and_its_vorticity_lies_along_its_velocity(rng):
    flow, points = EXAMPLES["abc"], CENTRE + rng.uniform(-4.0, 4.0, (20, 3))
    # a quarter wavelength along z: sin is 1, cos is 0
    assert flow(np.array([(0.0, 0.0, 2.0)]) + CENTRE)[0] == pytest.approx([0.05 - 0.02, 0.0, 0.03])
    slope = flow.gradient(points)
    vorticity = np.stack([slope[:, k - 1, k - 2] - slope[:, k - 2, k - 1] for k in range(3)], axis=1)
    assert vorticity == pytest.approx(1e3 * 2.0 * np.pi / 8.0 * flow(points))


def test_vortex_ring_blows_through_its_middle_and_ends_a_few_cores_off():
    flow, axis = vortex_ring(0.05, 4.0, 0.2, "y", CENTRE), np.eye(3)[[2, 0, 1]]
    ring = CENTRE + 4.0 * axis[0]
    # about a thin core the fluid turns, forwards inside, with the given speed
    inside, outside, ahead, behind = flow(ring + 0.2 * np.stack([-axis[0], axis[0], axis[2], -axis[2]]))
    assert inside == pytest.approx(0.05 * axis[2], rel=0.05, abs=1e-10)
    assert outside == pytest.approx(-0.05 * axis[2], rel=0.2, abs=1e-10)
    # in front and behind it moves forwards, too, by twice the core's share of the radius
    assert ahead == pytest.approx(0.05 * axis[0] + 0.005 * axis[2], abs=1e-4)
    assert behind == pytest.approx(-0.05 * axis[0] + 0.005 * axis[2], abs=1e-4)
    thick = vortex_ring(0.05, centre_mm=CENTRE)
    assert thick(np.array([CENTRE]))[0] == pytest.approx([0.0, 0.0, 0.05], abs=1e-12)
    far = CENTRE + 12.0 * np.eye(3)
    assert np.abs(thick(far)).max() < 1e-6


def test_source_has_its_divergence_and_sinks_take_the_fluid_up():
    flow = EXAMPLES["source"]
    divergence = np.trace(flow.gradient(CENTRE + np.outer([0.0, 2.0, 4.0], (0.0, 0.6, 0.8))), axis1=1, axis2=2)
    # 3 q (1 - r^2 / (3 radius^2)) exp(-r^2 / (2 radius^2))
    assert divergence == pytest.approx([40.0, 40.0 * 2.0 / 3.0 * np.exp(-0.5), -40.0 / 3.0 * np.exp(-2.0)])
    # at one radius q r exp(-1/2), in mm/s, plus the uniform velocity
    moved = flow(np.array([(2.0, 0.0, 0.0)]) + CENTRE)[0]
    assert moved == pytest.approx([1e-3 * 80.0 / 3.0 * np.exp(-0.5), 0.01, 0.0])


def test_advection_follows_a_circle_and_returns(rng):
    points = CENTRE + rng.uniform(-5, 5, (20, 3))
    omega, duration = np.array([40.0, -30.0, 20.0]), 5e-3
    turned = Rotation.from_rotvec(omega * duration).apply(points - CENTRE) + CENTRE
    # 0.27 rad in four steps of (0.27/4)^5/120 each, 8 mm from the centre at most: 4e-7 mm
    assert advect(rigid_rotation(omega, CENTRE), points, duration) == pytest.approx(turned, abs=4e-7)
    points = CENTRE + rng.uniform(-4, 4, (20, 3))
    for flow in EXAMPLES.values():
        assert advect(flow, advect(flow, points, 2e-3), -2e-3) == pytest.approx(points, abs=1e-9)


def test_pulsation_carries_tracers_as_its_equation_of_motion_does():
    flow, pulsation, start = EXAMPLES["taylor_green"], flows.Pulsation(0.7, 40.0), np.array(CENTRE) + (1.0, 0.0, 1.5)

    def motion(time_s, place):
        return 1e3 * (1.0 + 0.7 * np.sin(2.0 * np.pi * 40.0 * time_s)) * flow(place[np.newaxis])[0]

    for time_s in (-0.02, 0.003, 0.02):
        expected = solve_ivp(motion, (0.0, time_s), start, rtol=1e-10, atol=1e-10).y[:, -1]
        # four Runge-Kutta steps over 1 mm in vortices of 8 mm: 1e-5 mm
        assert advect(flow, [start], pulsation.carried_s(time_s))[0] == pytest.approx(expected, abs=2e-5)
    assert flows.STEADY.carried_s(-0.0123) == -0.0123
    # 50 % at 20 Hz: 2 pi 20 0.5 = 62.83 per second of the velocity; over 0.1 ms the cubic term is 1e-5 of it
    pulsation, step = flows.Pulsation(0.5, 20.0), 1e-4
    change = (pulsation.carried_s(step) + pulsation.carried_s(-step) - 2.0 * pulsation.carried_s(0.0)) / step**2
    assert change == pytest.approx(62.832, rel=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_modes_have_their_rms_and_a_kolmogorov_spectrum(seed, rng):
    points = rng.uniform(-2000.0, 2000.0, (20000, 3))
    flow = random_modes(0.05, seed=seed, velocity_m_s=(0.1, 0.0, 0.0))
    velocity = flow(points) - (0.1, 0.0, 0.0)
    # 200 modes in random directions: components share the energy within a tenth, and the sum is exact but for sampling
    assert np.sqrt(np.mean(velocity**2)) == pytest.approx(0.05, rel=0.02)
    np.testing.assert_allclose(velocity.std(axis=0), 0.05, rtol=0.2)
    # the structure function of E(k) ~ k^(-5/3) between the longest and the shortest wave, by quadrature
    step = rng.normal(size=points.shape)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    low, high = 2.0 * np.pi / 20.0, 2.0 * np.pi / 0.7
    for distance in (0.3, 1.0, 3.0):
        found = np.mean(np.sum((flow(points + distance * step) - flow(points)) ** 2, axis=1))
        lost = quad(lambda k, r=distance: k ** (-5 / 3) * np.sin(k * r) / (k * r), low, high)[0]
        energy = quad(lambda k: k ** (-5 / 3), low, high)[0]
        assert found == pytest.approx(6.0 * 0.05**2 * (1.0 - lost / energy), rel=0.3)


def test_random_modes_are_those_of_their_seed(rng):
    points = rng.uniform(-5.0, 5.0, (10, 3))
    first, again, other = (random_modes(0.05, seed=seed)(points) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)
    moved = random_modes(0.05, seed=4, centre_mm=(1.0, 2.0, 3.0))(points + (1.0, 2.0, 3.0))
    np.testing.assert_allclose(moved, first, atol=1e-12)
