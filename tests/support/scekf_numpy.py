"""A slow, plain stochastic-cloning EKF: dense covariance, one sample at a time, a list of clones
that grows and shrinks.

Written from the published equations and sharing no code with the package, it is the oracle of the
filter's tests.
"""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

G = np.array([0.0, 0.0, -9.81])
TLIO_STD = dict(
    tilt=np.deg2rad(1.0),
    yaw=np.deg2rad(0.1),
    velocity=1.0,
    position=1e-3,
    gyro_bias=1e-4,
    accel_bias=0.02,
)


def skew(v):
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def right_jacobian(phi, terms=30):
    """By its power series, sum over k of (−hat φ)^k / (k + 1)!."""
    total, term = np.zeros((3, 3)), np.eye(3)
    for k in range(terms):
        total = total + term
        term = term @ (-skew(phi)) / (k + 2)
    return total


def step_mean(R, v, p, bg, ba, gyro, accel, dt):
    dv = R @ (accel - ba) * dt
    return (
        R @ Rotation.from_rotvec((gyro - bg) * dt).as_matrix(),
        v + dv + G * dt,
        p + v * dt + 0.5 * dv * dt + 0.5 * G * dt**2,
    )


def yaw_matrix(R):
    """From SciPy's extrinsic Euler angles."""
    yaw = Rotation.from_matrix(R).as_euler("xyz")[2]
    return Rotation.from_euler("z", yaw).as_matrix()


def update(state, P, H, r, S):
    """State and covariance after a measurement with the residual r."""
    R, v, p, bg, ba, errors, ring = state
    core = 15 + len(errors)
    K = np.linalg.solve(S, H @ P).T
    P = P - K @ H @ P
    delta = K @ r
    ring = [
        [Rotation.from_rotvec(e[:3]).as_matrix() @ Rc, pc + e[3:]]
        for e, (Rc, pc) in zip(delta[core:].reshape(-1, 6), ring, strict=True)
    ]
    turned = Rotation.from_rotvec(delta[:3]).as_matrix() @ R
    moved = v + delta[3:6], p + delta[6:9], bg + delta[9:12], ba + delta[12:15]
    return (turned, *moved, errors + delta[15:core], ring), 0.5 * (P + P.T)


def run_from(state, noise, config, gyro, accel, displacement=None, covariance=None, **others):
    """`run` from a filter's state, with its `NoiseModel` and its `FilterConfig`; `others` are given
    beside or instead of theirs."""
    mean = {"R": state.rotation, "v": state.velocity, "p": state.position}
    mean |= {"bg": state.gyro_bias, "ba": state.accel_bias}
    options = dict(
        dt=config.dt,
        n=config.samples_per_clone,
        clones=config.clones_per_window,
        sigma_gyro=noise.gyro_density / np.sqrt(config.dt),
        sigma_accel=noise.accel_density / np.sqrt(config.dt),
        walk_gyro=noise.gyro_bias_walk,
        walk_accel=noise.accel_bias_walk,
        scale=noise.measurement_scale,
        fail_scale=config.mahalanobis_fail_scale,
        threshold=config.gate_threshold,
        convergence=config.convergence_seconds,
        success=config.success_seconds,
        pause=config.pause_seconds,
        correlated=None if noise.correlation is None else noise.correlation._asdict(),
    )
    mean = {name: np.asarray(value) for name, value in mean.items()}
    return run(gyro, accel, displacement, covariance, **mean, **(options | others))


def run(
    gyro,
    accel,
    displacement,
    covariance,
    R,
    v,
    p,
    *,
    dt,
    n,
    clones,
    sigma_gyro,
    sigma_accel,
    walk_gyro=1e-6,
    walk_accel=1e-4,
    bg=None,
    ba=None,
    std=TLIO_STD,
    scale=10.0,
    fail_scale=0.0,
    threshold=11.345,
    convergence=10.0,
    success=0.5,
    pause=1.0,
    measure=None,
    frame="given",
    correlated=None,
    fixes={},
):
    """Returns a dict of histories.

    measure(k, clone_rotation, bg, ba), where given, supplies displacement and covariance at step k.
    frame "own": the displacement turns with the filter's own attitude, whose yaw then cancels.
    correlated: share and seconds of the temporally correlated part of a window's error.
    fixes: {k: (position (2,) or (3,), covariance, seconds before the end of step k, standard
    deviation of its time)}, refused above the 99 % of χ²."""
    bg, ba = np.zeros(3) if bg is None else bg, np.zeros(3) if ba is None else ba
    parts = ("tilt", "yaw", "velocity", "position", "gyro_bias", "accel_bias")
    first = np.repeat([std[part] for part in parts], [2, 1, 3, 3, 3, 3])
    errors = np.zeros(0 if correlated is None else 3)
    decay = np.ones(len(errors))
    if correlated is not None:
        decay = np.exp(-n * dt / correlated["seconds"]) * np.ones(3)
    core = 15 + len(errors)
    P = np.diag(np.concatenate([first**2, np.ones(len(errors))]))
    ring, out = [], {}
    converged, last_success, pause_end = False, None, None
    for k in range(len(gyro) // n):
        for j in range(k * n, (k + 1) * n):
            phi = (gyro[j] - bg) * dt
            dv = R @ (accel[j] - ba) * dt
            R_old = R
            R, v, p = step_mean(R, v, p, bg, ba, gyro[j], accel[j], dt)
            A = np.eye(15)
            A[3:6, 0:3], A[6:9, 0:3], A[6:9, 3:6] = -skew(dv), -skew(0.5 * dv * dt), np.eye(3) * dt
            A[0:3, 9:12] = -R @ right_jacobian(phi) * dt
            A[3:6, 12:15], A[6:9, 12:15] = -R_old * dt, -0.5 * R_old * dt**2
            B = -A[:, 9:15]
            B[9:] = 0
            Q = B @ np.diag([sigma_gyro**2] * 3 + [sigma_accel**2] * 3) @ B.T
            Q[9:, 9:] += dt * np.diag([walk_gyro**2] * 3 + [walk_accel**2] * 3)
            full = np.eye(len(P))
            full[:15, :15] = A
            P = full @ P @ full.T
            P[:15, :15] += Q
        errors = decay * errors
        P[15:core] *= decay[:, None]
        P[:, 15:core] *= decay
        P[15:core, 15:core] += np.diag(1 - decay**2)
        ring.append([R, p])
        pick = np.concatenate([np.eye(len(P)), np.eye(len(P))[[0, 1, 2, 6, 7, 8]]])
        P = pick @ P @ pick.T

        tried = False
        row = dict(accepted=np.nan, gate_passed=np.nan, nis=np.nan)
        row |= dict(innovation=np.full(3, np.nan), displacement=np.full(3, np.nan))
        row |= dict(innovation_covariance=np.full((3, 3), np.nan))
        if len(ring) == clones + 1:
            if measure is None:
                d, C = displacement[k], covariance[k]
            else:
                d, C = measure(k, ring[0][0], bg, ba)
            if np.isfinite(d).all() and np.isfinite(C).all():
                Ri, pi = ring[0]
                Ry = yaw_matrix(Ri)
                q, y = Rotation.from_matrix(Ri).as_euler("xyz")[1:]
                gimbal = frame == "given" and abs(np.cos(q)) < 1e-5
                tried = not gimbal
                Hz = np.zeros((3, 3))
                Hz[2, 2] = 1
                if frame == "given" and not gimbal:
                    Hz[2, :2] = np.cos(y) * np.tan(q), np.sin(y) * np.tan(q)
                H = np.zeros((3, len(P)))
                of_clone = slice(core, core + 3), slice(core + 3, core + 6)
                H[:, of_clone[0]], H[:, of_clone[1]] = Ry.T @ skew(p - pi) @ Hz, -Ry.T
                H[:, -3:] = Ry.T
                expected, noise, correlated_part = Ry.T @ (p - pi), scale * C, 0
                if correlated is not None:
                    share, root = correlated["share"], np.linalg.cholesky(noise)
                    H[:, 15:18] = share * root
                    expected = expected + share * root @ errors
                    correlated_part = share**2 * noise
                r = d - expected
                S = H @ P @ H.T + noise - correlated_part
                nis = r @ np.linalg.solve(S, r)
                row.update(nis=nis, innovation=r, innovation_covariance=S, displacement=d)
                row.update(accepted=0.0, gate_passed=0.0)
                if not gimbal:
                    now, oldest = (k + 1) * n, (k + 1 - clones) * n  # samples since the start
                    converged = converged or oldest > round(convergence / dt)
                    active = converged and (pause_end is None or now >= pause_end)
                    age = 0 if last_success is None else now - last_success
                    if active and age > round(success / dt):
                        last_success, pause_end, active = None, now + round(pause / dt), False
                    if active and nis > threshold:
                        if fail_scale > 0:
                            S = H @ P @ H.T + fail_scale * noise - correlated_part
                            row["accepted"] = 1.0
                    else:
                        last_success = now
                        row["accepted"] = row["gate_passed"] = 1.0
                    if row["accepted"]:
                        state, P = update((R, v, p, bg, ba, errors, ring), P, H, r, S)
                        R, v, p, bg, ba, errors, ring = state
        row["fix_nis"] = np.nan
        if k in fixes:
            z, C, before, time_std = fixes[k]
            H = np.zeros((len(z), len(P)))
            H[:, 6 : 6 + len(z)] = np.eye(len(z))
            H[:, 3 : 3 + len(z)] = -before * np.eye(len(z))
            r = z - (p - before * v)[: len(z)]
            S = H @ P @ H.T + C + time_std**2 * np.outer(v, v)[: len(z), : len(z)]
            row["fix_nis"] = r @ np.linalg.solve(S, r)
            if row["fix_nis"] <= chi2.ppf(0.99, len(z)):
                state, P = update((R, v, p, bg, ba, errors, ring), P, H, r, S)
                R, v, p, bg, ba, errors, ring = state
        if len(ring) == clones + 1:
            ring.pop(0)
            keep = np.r_[0:core, core + 6 : len(P)]
            P = P[np.ix_(keep, keep)]
        if not tried and last_success is not None:  # absence is not staleness
            last_success += n
        row.update(rotation=R, velocity=v, position=p, gyro_bias=bg, accel_bias=ba)
        row.update(correlated=errors, correlated_covariance=P[15:core, 15:core])
        row.update(covariance=P[:15, :15], covariance_diagonal=np.diag(P)[:15])
        for name, value in row.items():
            out.setdefault(name, []).append(value)
    return {name: np.array(value) for name, value in out.items()}
