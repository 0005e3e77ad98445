"""Errata of the paper, sections II, VI and IX: state space, frames, dynamics, controller (docs: errata.md)."""

import numpy as np
import pytest
import sympy as sp
from errata_tools import (
    DT,
    E3,
    INERTIA,
    MASS,
    PRINTED_21,
    PRINTED_46,
    PRINTED_47,
    G,
    Ix,
    Iy,
    Iz,
    R,
    derivative,
    dt,
    flights,
    g,
    m,
    phi,
    psi,
    rate,
    skew,
    theta,
    thrust,
    turn,
    wx,
    wy,
    wz,
    zero,
)  # fmt: skip
from scipy.integrate import quad

from crazyem.control import lqg
from crazyem.paper import plant
from crazyem.physics.rotations import quaternion_from_euler, rotation_matrix
from crazyem.vehicle import GRAVITY

pytestmark = pytest.mark.slow  # about the paper: no code of ours but its plant is in it


def _angles(seed: int = 0, n: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1.2, -1.2, -3.0], [1.2, 1.2, 3.0], (n, 3))


# -- II.B: state space ------------------------------------------------------------------------------------------------


def test_3_without_the_input_the_next_state_is_not_determined():
    hover, falling, out = np.zeros(12), np.zeros(12), np.empty(12)
    for thrust_now, x in ((MASS * G, hover), (0.0, falling)):
        plant.step(x, np.array([thrust_now, 0, 0, 0]), np.zeros(4), DT, MASS, INERTIA, False, out)
    assert np.allclose(hover, 0, atol=1e-15)
    assert falling[5] == pytest.approx(-G * DT)  # same x_k-1, other x_k


@pytest.mark.parametrize("n", [1, 2, 12])
def test_5_normalisation_of_a_gaussian_in_more_than_one_dimension(n):
    rng = np.random.default_rng(n)
    a = rng.normal(size=(n, n))
    q = a @ a.T + np.eye(n)
    # integral of exp(-x' Q^-1 x / 2): independent axes after x = L z, one quadrature each
    one = quad(lambda z: np.exp(-z * z / 2), -12, 12)[0]
    integral = one**n * np.sqrt(np.linalg.det(q))
    assert (2 * np.pi) ** (-n / 2) * np.linalg.det(q) ** -0.5 * integral == pytest.approx(1)
    printed = (2 * np.pi * np.linalg.det(q)) ** -0.5 * integral
    assert printed == pytest.approx((2 * np.pi) ** ((n - 1) / 2))  # 1, 2.5, 24 500
    if n == 12:
        assert printed == pytest.approx(24_500, rel=0.01)


def test_5_process_noise_of_the_quadcopter_has_rank_four_and_no_density():
    x, u = np.zeros(12), np.array([MASS * G, 0, 0, 0])
    x[6:9] = [0.3, -0.2, 0.4]
    columns = []
    for i in range(4):
        moved, out, still, end = np.zeros(4), np.empty(12), x.copy(), x.copy()
        moved[i] = 1e-3
        plant.step(still, u, np.zeros(4), DT, MASS, INERTIA, False, out)
        plant.step(end, u, moved, DT, MASS, INERTIA, False, out)
        columns.append((end - still) / 1e-3)
    gq = np.array(columns).T
    q = gq @ np.diag([0.005, 0.002, 0.002, 0.002]) ** 2 @ gq.T / DT
    assert np.linalg.matrix_rank(gq) == 4
    assert np.sum(np.linalg.eigvalsh(q) > 1e-15) == 4  # of 12: det Q = 0, Q^-1 does not exist


# -- VI: frames and dynamics ------------------------------------------------------------------------------------------


def test_46_is_the_transpose_of_the_matrix_the_other_equations_need():
    assert zero(PRINTED_46 - R.T)
    # as a product it holds only for passive rotations
    assert zero(PRINTED_46 - turn("x", phi).T * turn("y", theta).T * turn("z", psi).T)
    assert not zero(PRINTED_46 - turn("x", phi) * turn("y", theta) * turn("z", psi))
    # x = R_B^E x_B turns with the body: R' = R skew(w) with the angles' rates of eq. 47
    rates = PRINTED_47 * rate

    def along(matrix):
        return sum((matrix.diff(a) * d for a, d in zip((phi, theta, psi), rates, strict=True)), sp.zeros(3))

    assert zero(along(R) - R * skew(rate))
    assert not zero(along(PRINTED_46) - PRINTED_46 * skew(rate))
    # the entry that eq. 107 uses is the same in both; at psi = 0 the lateral ones change sign
    assert PRINTED_46[2, 2] == R[2, 2]
    level = {phi: 0, theta: 0, psi: 0}
    slopes = [(matrix * E3).jacobian([phi, theta]).subs(level) for matrix in (R, PRINTED_46)]
    assert slopes[0] == -slopes[1] == sp.Matrix([[0, 1], [-1, 0], [0, 0]])


def test_46_is_right_in_the_code():
    symbolic = sp.lambdify((phi, theta, psi), R)
    out = np.empty(3)
    for angles in _angles():
        right = np.asarray(symbolic(*angles), float)
        plant.thrust_axis(angles, out)
        assert np.allclose(out, right[:, 2], atol=1e-14)
        assert np.allclose(rotation_matrix(quaternion_from_euler(*angles)), right, atol=1e-14)


def test_46_as_printed_flies_away():
    """One metre aside of the hover point, 4 s: the lateral force has the wrong sign."""
    gains = np.array([*lqg.position_gains(dt=DT, position_weight=16.0, velocity_weight=4.0), 20.0, 20.0])
    ends = []
    for sign in (1.0, -1.0):  # printed: third column (-s_theta, s_phi c_theta, c_phi c_theta)
        x, u = np.zeros(12), np.zeros(4)
        x[0] = 1.0
        for _ in range(800):
            lqg.control(x, np.zeros(9), 0.0, gains, 9.0, MASS, INERTIA, u)
            change = derivative(x, u, MASS, INERTIA)
            change[3:5] *= sign  # yaw stays zero
            x = x + DT * change
            if np.linalg.norm(x[:3]) > 30:
                break
        ends.append(np.linalg.norm(x[:3]))
    assert ends[0] < 0.01
    assert ends[1] > 30


def test_52_scalar_thrust_times_a_matrix_is_not_an_acceleration():
    wrong = R * thrust / m
    assert wrong.shape == (3, 3)  # cannot be added to -g e3; also the block of G in eq. 55
    with pytest.raises(sp.matrices.exceptions.ShapeError):
        wrong + -g * E3
    right = R * E3 * thrust / m - g * E3
    printed_48 = (sp.Matrix([0, 0, -m * g]) + R * sp.Matrix([0, 0, thrust])) / m  # eq. 48 is fine, given R
    assert zero(right - printed_48)
    x, out = np.zeros(12), np.empty(12)
    x[6:9], x[9:12] = [0.4, -0.3, 1.1], [1.0, -2.0, 0.5]
    plant.derivative(x, 1.5, np.array([1e-3, 2e-3, -1e-3]), MASS, INERTIA, out)
    expected = right.subs({thrust: 1.5, m: MASS, g: GRAVITY, phi: 0.4, theta: -0.3, psi: 1.1})
    assert np.allclose(out[3:6], np.array(expected, float).ravel())
    assert np.allclose(out, derivative(x, np.array([1.5, 1e-3, 2e-3, -1e-3]), MASS, INERTIA))


# -- II.C: flatness ---------------------------------------------------------------------------------------------------


def _flat():
    a = sp.Matrix(sp.symbols("a_x a_y a_z", real=True))
    t = a + sp.Matrix([0, 0, g])
    y_c = sp.Matrix([-sp.sin(psi), sp.cos(psi), 0])
    x_c = sp.Matrix([sp.cos(psi), sp.sin(psi), 0])
    return a, t, x_c, y_c


def test_12_x_body_lies_in_the_plane_of_x_c_and_the_vertical():
    _, t, x_c, y_c = _flat()
    x_b = y_c.cross(t)
    assert zero(x_b.dot(x_c.cross(E3)))  # coplanar with x_C and z_E
    assert not zero(x_b.dot(x_c.cross(sp.Matrix([1, 0, 0]))))  # printed: x_C and x_E, which is the horizontal plane
    # and eq. 12 fails where thrust lies along y_C: 90 degrees of roll
    assert zero(y_c.cross(y_c))


def test_11_and_83_ask_for_different_thrusts():
    """Commanded 5 m/s^2 forward while still level: 11 wants m |t|, 83 wants m (ua_z + g)."""
    t = np.array([5.0, 0.0, G])
    by_11, by_83 = MASS * np.linalg.norm(t), MASS * G / (np.cos(0) * np.cos(0))
    assert by_11 / by_83 == pytest.approx(1.122, abs=1e-3)
    # they agree once the attitude is the one that t asks for
    angles = np.empty(3)
    specific = lqg.reference_angles(t - [0, 0, G], 0.7, angles)
    assert MASS * specific == pytest.approx(MASS * G / (np.cos(angles[0]) * np.cos(angles[1])))


def test_83_grows_without_bound_and_the_code_limits_it():
    u, gains = np.empty(4), np.array([4.0, 4.0, 20.0, 20.0])
    x = np.zeros(12)
    x[6] = np.radians(89.9)
    lqg.control(x, np.zeros(9), 0.0, gains, 9.0, MASS, INERTIA, u)
    assert MASS * G / np.cos(x[6]) > 500 * MASS * G
    assert u[0] == pytest.approx(MASS * GRAVITY / lqg.SMALLEST_TILT_COSINE)
    x[6] = np.radians(100)  # printed: negative thrust
    assert MASS * G / np.cos(x[6]) < 0
    lqg.control(x, np.zeros(9), 0.0, gains, 9.0, MASS, INERTIA, u)
    assert u[0] > 0


def test_82_as_printed_leaves_the_horizontal_position_uncontrolled():
    """ua_x, ua_y enter neither 83 nor 84: one metre aside stays one metre aside; through t of eq. 8 it is corrected."""
    k_p, k_v, k_a, k_w = *lqg.position_gains(dt=DT, position_weight=16.0, velocity_weight=4.0), 20.0, 20.0
    printed, x, u = np.zeros(12), np.zeros(12), np.zeros(4)
    printed[0] = x[0] = 1.0
    for _ in range(1600):
        ua = -k_p * printed[:3] - k_v * printed[3:6]
        alpha = -k_w * (printed[9:] + k_a * printed[6:9])  # the reference attitude of a resting reference is level
        force = (ua[2] + G) * MASS / (np.cos(printed[6]) * np.cos(printed[7]))
        printed = printed + DT * derivative(printed, np.array([force, *(INERTIA * alpha)]), MASS, INERTIA)
        lqg.control(x, np.zeros(9), 0.0, np.array([k_p, k_v, k_a, k_w]), 9.0, MASS, INERTIA, u)
        x = x + DT * derivative(x, u, MASS, INERTIA)
    assert abs(printed[0] - 1.0) < 1e-9
    assert abs(x[0]) < 1e-4


@pytest.mark.parametrize(("feed_forward", "lag"), [(0.0, 1 / 40), (1.0, 0.0)])
def test_18_without_feed_forward_the_attitude_lags(feed_forward, lag):
    """A reference that turns at 1 rad/s is followed 1/K_theta late, 0.025 rad with 40 1/s."""
    angle = velocity = 0.0
    wanted, rates = np.zeros(3), np.empty(3)
    for k in range(2000):
        wanted[0] = k * 1e-3
        lqg.reference_rate(np.array([angle, 0.0, 0.0]), wanted, 40.0, rates)
        velocity += 1e-3 * 25.0 * (rates[0] + feed_forward - velocity)
        angle += 1e-3 * velocity
    assert wanted[0] - angle == pytest.approx(lag, abs=1.1e-3)  # one step of the loop


def test_18_the_yaw_error_must_be_wrapped():
    """Heading 3.1, wanted -3.1 rad: printed turns back through 6.2 rad, the code on through 0.08 rad."""
    rates = np.empty(3)
    lqg.reference_rate(np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1]), 40.0, rates)
    printed = -40.0 * (3.1 - -3.1)
    assert printed < -200
    assert rates[2] == pytest.approx(40.0 * (2 * np.pi - 6.2))


def test_82_without_weights_the_attitude_loop_is_undetermined():
    """LQR with unit weights, and K_theta = 40 in the reference of the rate: damping 0.10; with 20 and 20 it is 0.5."""
    import control as ct

    k, _, _ = ct.lqr(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))
    stiffness, damping = k[0, 0] + 40.0 * k[0, 1], k[0, 1]  # the angle error acts twice, in 18 and in 82
    assert damping / (2 * np.sqrt(stiffness)) == pytest.approx(0.103, abs=0.002)
    assert 20.0 / (2 * np.sqrt(20.0 * 20.0)) == 0.5


# -- IX: LQG ----------------------------------------------------------------------------------------------------------


def _chain():
    a, b = np.zeros((12, 12)), np.zeros((12, 6))
    a[0:3, 3:6] = a[6:9, 9:12] = np.eye(3)
    b[3:6, 0:3] = b[9:12, 3:6] = np.eye(3)
    return a, b


def test_79_continuous_matrices_are_not_a_discrete_model():
    import control as ct

    a, b = _chain()
    x, u = np.arange(12.0), np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    nilpotent = np.eye(12) + a * DT  # exp(A dt) = 1 + A dt, since A A = 0
    held = b * DT + a @ b * DT**2 / 2
    exact = ct.sample_system(ct.ss(a, b, np.eye(12), np.zeros((12, 6))), DT)
    assert np.allclose(exact.A, nilpotent)
    assert np.allclose(exact.B, held)
    assert not np.allclose(a @ x + b @ u, nilpotent @ x + held @ u, rtol=0.1)


def test_appendix_a_the_row_of_roll_has_its_one_in_the_wrong_column():
    """Gains made from the printed matrix leave roll without a restoring torque: a pole at zero."""
    import control as ct

    a, b = _chain()
    printed = a.copy()
    printed[6, 9], printed[6, 8] = 0.0, 1.0  # column 9 (psi) instead of 10 (omega_x)
    assert zero(sp.Matrix([wx])[0] - rate[0])
    for model, stable in ((a, True), (printed, False)):
        k, _, _ = ct.lqr(model, b, np.eye(12), np.eye(6))
        poles = np.linalg.eigvals(a - b @ k).real
        assert (poles.max() < -0.4) == stable
        assert (abs(k[3, 6]) > 0.9) == stable  # roll torque from roll error


# -- found right ------------------------------------------------------------------------------------------------------


def test_right_8_to_17_flatness():
    a, t, x_c, y_c = _flat()
    x_b = y_c.cross(t)
    y_b = t.cross(x_b)
    assert zero(x_b.dot(t))
    assert zero(x_c.dot(y_c))
    assert zero(y_c - turn("z", psi)[:, 1])
    assert zero(x_c - turn("z", psi)[:, 0])
    basis = sp.Matrix.hstack(x_b, y_b, t).subs({psi: 0.3, a[0]: 1.0, a[1]: -2.0, a[2]: 0.7, g: 9.81})
    assert float(basis.det()) > 0  # eq. 13: right-handed
    # 15-17 invert R (entries counted from 0)
    assert zero(R[2, 0] + sp.sin(theta))
    assert zero(R[2, 1] / sp.cos(theta) - sp.sin(phi))
    assert zero(R[2, 2] / sp.cos(theta) - sp.cos(phi))
    assert zero(R[1, 0] / sp.cos(theta) - sp.sin(psi))
    assert zero(R[0, 0] / sp.cos(theta) - sp.cos(psi))


def test_right_20_21_47_rates_of_the_angles():
    assert zero(PRINTED_21 * PRINTED_47 - sp.eye(3))
    rates, error = np.empty(3), np.array([0.1, -0.2, 0.3])
    for angles in _angles(3):
        lqg.reference_rate(angles, angles + error, 1.0, rates)  # 20
        assert np.allclose(rates, np.array(PRINTED_21.subs(dict(zip((phi, theta), angles[:2]))), float) @ error)


def test_right_49_84_110_euler():
    """d/dt (R I w) = 0 without torque, and 110 is 109 written out."""
    inertia = sp.diag(Ix, Iy, Iz)
    torque = sp.Matrix(sp.symbols("M_x M_y M_z"))
    alpha = inertia.inv() * (torque - rate.cross(inertia * rate))
    assert zero(inertia * alpha + rate.cross(inertia * rate) - torque)
    # momentum: R' I w + R I alpha = R M with R' = R skew(w)
    assert zero(skew(rate) * inertia * rate + inertia * alpha - torque)
    printed = sp.Matrix(
        [
            torque[0] / Ix + (Iy - Iz) / Ix * wy * wz,
            torque[1] / Iy + (Iz - Ix) / Iy * wx * wz,
            torque[2] / Iz + (Ix - Iy) / Iz * wx * wy,
        ]
    )
    assert zero(alpha - printed)
    assert zero((rate + alpha * dt) - (rate + printed * dt))  # 108


def test_right_101_vertical_component_of_48():
    acceleration = R * E3 * thrust / m - g * E3
    assert zero(acceleration[2] - (-g + thrust / m * sp.cos(phi) * sp.cos(theta)))


def test_right_77_78_80_81_linear_model():
    assert zero(PRINTED_47.subs({phi: 0, theta: 0}) - sp.eye(3))  # 77
    x, u = sp.Matrix(sp.symbols("x1:13")), sp.Matrix(sp.symbols("u1:7"))
    f = sp.Matrix([*x[3:6], *u[0:3], *x[9:12], *u[3:6]])
    a, b = _chain()
    assert np.array_equal(np.array(f.jacobian(x), float), a)
    assert np.array_equal(np.array(f.jacobian(u), float), b)  # B of the appendix


def test_57_the_arm_is_used_by_no_equation():
    """F and M are the inputs. With the arm, one of four rotors would have to pull in about 0.1 % of the steps."""
    u = flights(8).wrench[:, :-1]
    least = u[..., 0] / 4 - (abs(u[..., 1]) + abs(u[..., 2])) / (2 * np.sqrt(2) * 0.086)
    assert 0.0003 < np.mean(least < 0) < 0.004
