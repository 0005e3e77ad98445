"""The chosen numbers of the diagnosis, in one frozen table: value, unit and meaning, and a source where one exists.

A section holds the numbers of one stage. A number without a source, data or a reason is assumed, as one that says so.
Sizes of an effect, its prior and its physical range stand with the effect (`physics/effects`). Constants of equations,
firmware and formats, and guards of numerical methods, are no settings and stand where they are used.

"Simulated" means flights of the simulated firmware; seeds are those of `benchmarks/concealed`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Recordings:
    """A recording as a flight (`flights/`)."""

    same_time: float = 1.5e-3  # s; closer samples are simultaneous; less than the shortest log period, 2 ms
    max_gap: float = 0.1  # s; longest time without inputs that is integrated over; assumed: two rotor lags
    sample_period: float = 0.01  # s; samples that are kept. Low passes of gyro and state estimate take 2 to 5 ms
    # (80 Hz: sensors_bmi088_bmp3xx.c); closer samples show the filter. Ten samples in a rise time are enough (Ljung,
    # System Identification, 1999, 13.7)
    min_duration: float = 4.0  # s of flight for a diagnosis; assumed
    piece: float = 60.0  # s after which the filter starts again: long flights are filtered in pieces; assumed
    block: float = 1.0  # s; scores are correlated for tenths of a second
    short_block: float = 0.5  # s; in short flights, for `blocks` blocks
    blocks: int = 40  # twice the number of nuisances
    edge: float = 0.5  # s that spectra and regressions leave out at both ends of a flight; assumed
    max_force_distance: float = 0.03  # s from a row to an interpolated sample of the accelerometer; assumed
    steady_voltage: float = 5e-3  # V; sd of means over a second below which the voltage is constant. It is 12 mV and
    # more in 51 simulated flights, 32 mV and more in 19 of CrazyPAD and NanoBench; 5 mV are 0.2 % of thrust
    nominal_voltage: float = 3.85  # V under load if none is recorded: middle of 3.7 to 4.0 V of a flight
    command_delay: float = 3.5e-3  # s; a command is held for 2 ms at 500 Hz, rates have a low pass of 80 Hz (2.8 ms)
    rate_delay: float = 2.1e-3  # s of rates behind a recorded attitude (physics/effects/onboard_estimate.py)
    stand_in_arm: float = 0.01  # m; arm, and torque per thrust, of a vehicle without rotors; its value cancels
    thrust_difference: float = 0.005  # relative; least difference between recordings that is reported; assumed
    hover_speed: float = 0.1  # m/s; horizontal, below which a flight hovers: hovers have 0.006 to 0.08, simulated
    hover_rate: float = 0.5  # rad/s; the same: hovers have 0.08 to 0.4 in gusts, small shakes 0.74 and more
    speed_ratio: float = 3.0  # of two flights, from which one is livelier: flights of a kind differ by chance; assumed


@dataclass(frozen=True)
class Clocks:
    """Delay between signals (`flights/alignment.py`, `naming/other_likelihoods.py`)."""

    max_delay: float = 0.15  # s, of either sign, between state and inputs; assumed
    max_delay_sd: float = 4e-3  # s; standard error of a delay that is used; assumed: half a sample
    axis_difference: float = 6e-3  # s, of roll and pitch, beside three standard errors; assumed
    min_explained: float = 0.1  # share of the variance of the acceleration that the rotors explain; assumed
    delay_sd: float = 0.01  # s; prior of delays; assumed: a sample
    collision: float = 300.0  # unexplained power of a block over that of the median block: at most 172 in 23 files of
    # real flights, 2652 in a crash
    step: float = 2.5e-3  # s between tried delays: a quarter of a sample
    grid: float = 5e-3  # s between rows
    band: tuple[float, float] = (0.015, 0.1)  # s; widths of two Gaussians whose difference passes 1.5 to 10 Hz
    filter_half: float = 0.3  # s; half the length of this filter: three widths
    min_blocks: int = 4  # of `Recordings.block`, for a standard error
    accelerometer_lag: float = 7.5e-3  # s; low pass of 30 Hz, second order (firmware of the Crazyflie, default of PX4)
    accelerometer_lag_sd: float = 3.4e-3  # s; 1.48 MAD of 28 simulated flights, median 7.4 ms
    max_sensor_delay: float = 0.1  # s, of either sign, of the accelerometer; assumed
    twin_speed_sd: float = 0.01  # relative; speeds of two healthy rotors at one command; assumed
    samples_of_block: int = 100  # for means of rotor speeds: a second
    min_speed_blocks: int = 8  # of these


@dataclass(frozen=True)
class Levelling:
    """World frames, floor and take-off (`flights/recording_nuisances.py`, `flights/inputs.py`)."""

    step: float = 0.01  # s between rows for second derivatives of the position
    width: int = 21  # rows of the polynomial (Savitzky and Golay): 0.2 s, shorter than manoeuvres
    min_blocks: int = 8  # for a standard deviation of angles
    min_angle_sd: float = 1e-5  # rad; a drone that stands on the floor has no scatter
    equal_p: float = 1e-3  # p-value of equal frames, above which frames are equal
    floor_range: float = 0.02  # m; range of the floors of the other recordings, height of a drone below the floor
    min_floors: int = 2  # other recordings that show the floor
    clear_height: float = 0.3  # m; 13 rotor radii, where the ground adds 0.04 % of thrust (Cheeseman and Bennett 1955)
    max_rise_time: float = 5.0  # s after take-off within which the drone is that high; else take-off itself counts
    use: float = 3.0  # s of flight that are used
    min_use: float = 1.0  # s
    looks: tuple[float, ...] = (0.2, 0.5, 1.0, 2.0)  # s after take-off at which a prediction estimates the voltage
    slope: float = 0.2  # s; length of a linear fit of the height for a velocity
    min_heights: int = 4  # in it
    voltage_range: tuple[float, float] = (0.4, 1.4)  # of a voltage over the nominal one: empty to overcharged


@dataclass(frozen=True)
class NoiseFit:
    """Scales of noise and errors with memory (`fitting/noise.py`, `fitting/model.py`, `fitting/specific_force.py`)."""

    rows: int = 1500  # of each flight for the fit of the scales; they know a scale to some 1 %
    stretch: int = 750  # rows without a gap; in short ones the filter starts often and velocities seem too accurate
    rough_rows: int = 900  # the same for a first, rough fit
    rough_stretch: int = 150  # rows of a stretch there
    log_sd: float = 2.0  # sd of the logarithm of a scale about its typical value: a factor of seven; assumed
    max_steps: int = 40  # of scoring
    log_step: float = 0.02  # of the logarithm, for differences
    max_log_step: float = 1.5  # in scoring
    # Typical scales of a small quadrotor, by order of magnitude; the prior is a factor of seven to either side.
    impulse: tuple[float, float] = (0.1, 1.0)  # m/s^2 sqrt(s), rad/s^2 sqrt(s)
    disturbance: tuple[float, float] = (0.1, 1.0)  # m/s^2, rad/s^2
    measurement: tuple[float, ...] = (1e-3, 1e-2, 3e-3, 1e-2)  # m, m/s, rad, rad/s; coloured errors alike
    recall: tuple[float, ...] = (0.06, 0.06, 0.06, 2.5e-3)  # s; correlation times. Position fixes correct an onboard
    # estimate in 0.04 s, errors of motion capture last longer; the gyro has a low pass of 80 Hz
    log_recall_sd: tuple[float, ...] = (1.0, 1.0, 1.0, 0.3)  # of their logarithms; assumed
    min_impulse: tuple[float, float] = (1e-3, 1e-2)  # least scales, far below those of any sensor
    min_disturbance: tuple[float, float] = (1e-4, 1e-3)  # m/s^2, rad/s^2
    min_measurement: tuple[float, ...] = (1e-5, 1e-4, 1e-4, 1e-4)  # m, m/s, rad, rad/s
    min_recall: float = 0.2  # of `recall`
    white_period: float = 3.0  # sampling period in correlation times, from which an error is white: exp(-3) = 5 %
    min_coloured: float = 0.6  # root spectral density of an error with memory, over that of the white one; assumed
    min_attitude: float = 3e-3  # rad; error of an attitude inferred from an acceleration: quiet flights have 4 to 5
    # mrad. With 0.5 mrad, noise of the acceleration would look like torques
    start_sd: tuple[float, ...] = (1.0, 2.0, 0.5, 3.0)  # m, m/s, rad, rad/s; of what is not measured at a start
    min_lateral: float = 0.05  # share of the force along x and y in a column, for which onboard estimates depend on it
    averaging: float = 0.5  # s; of the acceleration that a model lacks: much longer than a sample
    max_force_decay: float = 0.999  # from row to row, of the noise of an accelerometer: 10 s at 100 Hz
    min_forces: int = 100  # samples of an accelerometer: a second
    min_vibration: float = 0.05  # m/s^2; resolution and vibration of an accelerometer in flight
    max_force_residual: float = 6.0  # standard deviations at which residuals of an accelerometer are clipped
    chaos_velocity: float = 0.01  # m/s; error of an onboard velocity, by which a test for chaos moves the path
    chaos_change: float = 0.3  # share of the varying force that this changes: all in chaos, some per cent else
    chaos_swing: float = 0.2  # least varying share of the force: in a hover noise alone varies
    chaos_every: int = 6  # of so many starts of an effect one is tested


@dataclass(frozen=True)
class Fitting:
    """Maximum of the posterior (`fitting/fit.py`, `fitting/gram.py`, `fitting/nuisances.py`)."""

    rounds: int = 6  # of Gauss-Newton
    tries: int = 6  # of a step, each a third as long as the last
    min_round_gain: float = 0.05  # nats; a smaller step is the last of a fit, by the linear approximation; assumed
    passes: int = 8  # until the physics is evaluated at the states of the filter
    pass_change: float = 0.2  # nats between two passes, below which they have converged
    max_deviation: float = 2.5  # sd of its prior within which a nuisance stays: 99 % of a normal prior
    within_reach: float = 0.99  # share of `max_deviation`; a nuisance within it is determined
    outlier: float = 4.0  # mean square of the standardised innovations of a step that is left out
    start_torque: float = 0.5  # rad/s^2; start value of torques with memory
    air_memory: float = 0.5  # s; of torques by moving air; assumed
    min_lag_gain: float = 3.0  # nats by torques with the memory of the rotor lag; assumed: p = 0.1 for three numbers
    min_air_gain: float = 2.0  # nats a second, by torques with the memory of the air; assumed
    folds: int = 5  # of the flight, for cross-validation
    blocks_together: int = 3  # in a fold
    min_flights: int = 5  # for a scatter between flights
    lag_error: float = 3e-3  # s; rms error of a fitted rotor lag in 16 simulated flights without a missing effect
    min_thrust_flights: int = 3  # from which each has a thrust scale of its own; assumed
    prior_flights: float = 2.0  # that the spread of other drones counts as: the two drones of CrazyPAD differ by four
    # A loop at 500 Hz answers to vibration. Its commands, logged at 100 Hz, are nearly white: most are not logged.
    coarse_share: float = 0.2  # power above half the Nyquist frequency of torques of coarsely sampled commands (white:
    # 0.5). Simulated flights have up to 0.12; real ones and those of RotorPy more
    min_sampled_torque: float = 1e-3  # relative: a tenth of the uncertainty of inertias
    min_torque_frequency: float = 1.0  # Hz; slower torques are left out; assumed


@dataclass(frozen=True)
class Location:
    """Where simulation and flight part (`locating/`, `naming/unexplained.py`)."""

    bins: int = 4  # of a regime's axis
    finding_p: float = 1e-4  # largest p-value of a finding that is listed; assumed: 0.05 in 500 regimes
    min_structure: float = 25.0  # nats; structure by place or frequency that counts; assumed
    # Sizes that onboard filters and sampled commands leave in every flight.
    force: float = 0.01  # share of the weight
    torque: float = 0.0004  # share of weight times arm
    attitude: float = 5e-3  # rad
    velocity: float = 0.05  # m/s
    daily: float = 2.0  # factor on these if trim, thrust and leaning differ by 2 % between days or flights; assumed
    prior_precision: float = 1e-4  # (m/s^2)^-2, of a force by place: a force of ten g
    heading_window: float = 0.05  # s between the attitudes that are compared
    heading_gain: float = 15.0  # nats on fitted flights
    heading_held_out: float = 5.0  # nats on held-out flights; healthy flights gain 5 at most
    heading_share: float = 0.1  # expected gain on other flights over that on the first, from which they count; assumed
    min_heading: float = 5e-3  # rad; standard deviation of the error along the flight
    min_windows: int = 100  # windows of a recording; assumed
    wavelengths: tuple[float, ...] = (4.0, 2.0, 1.3, 1.0, 0.8)  # m; waves stay bounded where others fly further
    ridge: float = 1e-2  # relative


@dataclass(frozen=True)
class Spectrum:
    """Torques that are random or shake (`naming/unexplained.py`)."""

    chance: float = 1e-5  # p-value that no rotor stands out, corrected for the number of rotors
    min_t: float = 2.33  # of roll with pitch, and of both with yaw: p = 0.01 each; a product of inertia has one of them
    min_correlation: float = 0.03  # of the three axes; assumed
    outlier: float = 4.0  # standard deviations at which innovations are clipped
    piece: float = 5.0  # s; the speed of a rotor changes by less than a tenth
    min_pieces: int = 4  # pieces of a recording; assumed
    min_frequency: float = 1.5  # Hz; onboard filters drift below
    max_frequency: float = 0.4  # of the sampling rate
    surroundings: float = 4.0  # Hz; half width
    hump_width: float = 1.0  # Hz; half width
    min_hump: float = 10.0  # power over that of the surroundings; simulated drones without a missing effect: up to 3.4
    min_hump_torque: float = 0.15  # over inertia, over the angular acceleration in the band; less may be the loop
    min_line_torque: float = 0.3  # of a line over the swing's change in a step, which an unknown torque leaves whole
    line_surroundings: float = 0.15  # share of the frequency range


@dataclass(frozen=True)
class Selection:
    """Search over sets of effects (`naming/select.py`, `naming/prune.py`, `naming/trials.py`, ...)."""

    max_fitted: int = 6  # candidates of a turn
    min_fitted: int = 3  # candidates that are fitted whatever they gain
    gain_share: float = 0.15  # of the largest linear gain, with which a candidate is fitted; assumed
    max_effects: int = 9  # real drones differ from their file in more than one thing
    noise_share: float = 0.8  # of the best gain, from which a trial gets its own noise; assumed
    max_compared: int = 3  # of such trials
    full_fits: int = 5  # starting points that are all fitted in full
    peaks: int = 2  # best of more starting points that are
    chaos_gain: float = 50.0  # nats, with which a chaotic effect is tried with its `Effect.sizes`; assumed
    linear_gain: float = 20.0  # nats; a larger gain of one linear step is checked by the likelihood; assumed
    rival_difference: float = 100.0  # nats; a rival that was worse by less is compared again; assumed
    min_evidence: float = 8.0  # nats of an effect; assumed: odds 50 after 60 candidates
    kept_share: float = 0.5  # of its gain that a second effect keeps beside the first; with less, a look-alike
    onset_gain: float = 6.0  # nats of an onset; assumed: odds 400
    onset_scans: tuple[tuple[float, float], ...] = ((1.5, 0.1), (0.5, 0.1), (0.1, 0.02))  # s; reach, step of a scan
    separating: float = 3.0  # nats from which another signal separates two effects; assumed: odds 20
    max_error_ratio: float = 1.2  # of errors at 100 and 500 ms, geometric mean: true effects that were found in 210
    # simulated drones have at most 1.10


@dataclass(frozen=True)
class Confidence:
    """Probability of a name (`naming/trials.py`, `naming/answer.py`, `naming/balance.py`, `report/verdict.py`).

    Log-odds of the k-th effect found: intercept + gain_power log(1 + gain over dispersion) - order_power log(k) + those
    of held-out flights. Models are approximate: wrong effects gain tens of nats, with a heavy tail. So the odds grow
    with a power of the gain, not with its exponential. A file lacks one thing rather than three.

    Posterior mode from 38 names in 45 worlds, home, random and foreign (seeds 12501, 12602, 12703, 13602). The prior is
    normal about -7.5, 1.65, 1.1, from 79 names of other seeds with another dispersion; its sd 1.5, 0.4, 0.5 is assumed.
    The gain of these names is that on the fitted flights. Where held-out flights show more, their gain counts.
    """

    intercept: float = -6.8  # log-odds
    gain_power: float = 1.7  # log-odds per logarithm of the gain
    order_power: float = 1.2  # log-odds per logarithm of the order
    max_probability: float = 0.95  # of any name; assumed
    # Gain on held-out flights as a share of its expected value: about 1 for a real effect, whose model is approximate;
    # about 0 for another cause, which may act in both flights. The 38 names do not determine the three numbers.
    real_sd: float = 0.4  # assumed
    other_sd: float = 0.6  # assumed
    freedom: float = 4.0  # of Student's t: flights have unexpected errors of their own; assumed
    file_lacks: float = 0.05  # prior probability that a vehicle file lacks an effect: one drone of 20
    min_probability: float = 0.5  # of a finding
    doubtful: float = 0.45  # most beside structure that an effect does not outweigh
    outweighs: float = 3.0  # held-out gain of an effect over the structure, at which it is right in one half. Of 88
    # effects in 1268 simulated drones (seeds 2045 to 2048): 18 of 18 at 4 or more, 2 of 8 at 1 to 4, 6 of 62 at less
    improbable: float = 0.1  # below, an effect outside all groups is the nearest explanation: 2 of 18 are right in 1899
    # simulated drones (seeds 2038 to 2043)
    min_look_alike: float = 0.05  # probability of being the better explanation, from which one is a look-alike; assumed
    at_bound: float = 1e-9  # of the larger end of a range; a number this close to an end is at the end


@dataclass(frozen=True)
class Loads:
    """Steady forces and torques: what a hover can tell (`naming/balance.py`, `naming/evidence.py`)."""

    max_load: float = 1.0  # weight over the drone's; assumed
    max_place: float = 0.99  # share of the furthest place on board
    min_load: float = 0.005  # share of the drone's mass: filters and sampling look like smaller loads
    min_shift: float = 1e-4  # m; of the centre of mass
    min_gust_ratio: float = 2.0  # of gusts over those of the file
    min_trim_sd: float = 2.0  # standard deviations of the day's trim; shift of the centre of mass
    min_weight_sd: float = 3.0  # standard deviations of the weight by a swing: least weight, and thrust of an effect
    # beside such a load


@dataclass(frozen=True)
class Wind:
    """Forces with memory (`naming/other_likelihoods.py`)."""

    memories: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)  # s; correlation times that are tried
    min_gain: float = 40.0  # nats; assumed
    spread_sd: float = 0.2  # relative; it depends on the memory, and forces have other errors
    log_memory_sd: float = 0.5  # beyond scatter: rms error 0.55 in 21 simulated drones with gusts (seeds 2038, 2039)
    min_spread: float = 0.08  # m/s^2; onboard filters leave less
    max_axis_ratio: float = 3.0  # of the axes' spreads: moving air acts on all
    known_drag: float = 1e-3  # N s/m; a smaller drag is a nuisance near 0
    drag: float = 0.007  # N s/m, of a drone of unknown drag (docs/reference/effects.md)
    fixed_share: float = 0.3  # of their gain that a force by place or motion may have beside them; assumed


@dataclass(frozen=True)
class Accelerometer:
    """How the accelerometer is mounted (`naming/other_likelihoods.py`)."""

    step: float = 1e-3  # rad, for differences
    bias_sd: float = 0.03  # m/s^2; what remains after the firmware removes the bias at rest
    lag_sd: float = 0.02  # s
    yaw_sd: float = 0.1  # rad; prior: thrust along z does not show the yaw, and boards are glued within degrees
    min_angle: float = 3e-3  # rad; roll or pitch of a finding
    angle_sd: float = 5e-4  # rad; error beyond the scatter of blocks: in 42 simulated drones (seeds 2038 to 2041) the
    # intervals hold 80 of 84 angles with it, 75 without it


@dataclass(frozen=True)
class RotorResponse:
    """Measured rotor speeds against commands (`naming/rotor_response.py`)."""

    min_frequency: float = 0.5  # Hz; slower changes come from the battery
    spacing: float = 0.01  # s between compared thrusts, about
    max_period: float = 0.025  # s between samples
    min_samples: int = 400  # samples of a recording; assumed
    start_lags: tuple[float, ...] = (0.01, 0.03, 0.08)  # s
    command_period: float = 2e-3  # s; parts of a sample, in which the command is constant: a loop of 500 Hz
    min_lag: float = 2e-3  # s
    max_lag: float = 0.5  # s
    max_delay: float = 0.1  # s
    instruments: int = 8  # earlier samples of the command, and of the thrust
    spline_reach: int = 2  # samples to either side on which a cubic spline mainly depends
    near: tuple[int, int] = (-1, 3)  # samples of the thrust about a command
    min_f: float = 2.0  # first-stage F of the weakest direction (Cragg and Donald 1993); above it, the lag is off by at
    # most 15 % in eight simulated flights (seeds 14501, 14602, 14703)
    min_voltages: int = 30  # measurements of a voltage that show how the voltage drops under load; assumed
    lag_sd: float = 0.07  # relative; error beyond scatter: rms of eight flights (seeds 14501, 14602, 14703)
    delay_sd: float = 2.2e-3  # s; the same
    correlation: float = -0.6  # of these two errors
    max_residual: float = 3.0  # power of a rotor's residual over the median of the others: up to 1.2 in 13 simulated
    # drones, 5.5 and more in ten flights with a rotor that sticks within 1.4 to 5 % of full command
    independent: float = 10.0  # samples for one independent residual


@dataclass(frozen=True)
class Prediction:
    """Simulation from recorded states (`prediction/`)."""

    spacing: float = 0.1  # s between starts
    max_period: float = 0.025  # s between two samples for an interpolated truth
    oldest: float = 0.05  # s; age of a part of the state at a start
    chunk: int = 2048  # starts that are integrated together, to limit memory
    substep: float = 5e-3  # s; of the integration: a tenth of the rotor lag
    back: float = 5e-3  # s between the rows of a path before a start
    min_unrest: float = 2e-3  # m/s^2 sqrt(s); noise of a force seen in a recording
    beyond_chance: float = 2.0  # standard errors of a mean difference of squared errors: a model predicts worse
    min_ratio: float = 1.005  # of rms errors of a worse model; with less, they are equal in whole per cent
    min_windows: int = 5  # without overlap, for a standard error
    memory: float = 10.0  # s; exponential weights of older errors
    weight_sd: float = 1.0  # prior of the share of an error that persists
    offset_sd: float = 2.0  # rad/s^2; prior
    feedback_sd: tuple[float, ...] = (1.0, 2.0, 10.0, 2.0, 1.0, 1.0)  # 1/s, 1/s, rad/s^2 per rad, per m/s, per
    # (m/s)^2, per m; times h: priors of the feedback
    force_sd: float = 0.5  # m/s^2; prior
    force_memory: float = 0.1  # s; correlation time of errors of the force
    max_weight: float = 2.0  # that of a right model is 1
    min_rotation_time: float = 2.0  # s of flight before the rotation is corrected
    min_force_time: float = 0.3  # s before the force is; a frame 3 degrees off is 0.5 m/s^2 from the start on
    min_starts: int = 30  # errors from which twelve spreads are estimated
    ensemble_step: float = 0.01  # s; of the integration of hundreds of drones
    prior_time: float = 1.0  # s of flight that other flights count as in the scale of errors: two horizons


RECORDINGS = Recordings()
CLOCKS = Clocks()
LEVELLING = Levelling()
NOISE = NoiseFit()
FITTING = Fitting()
LOCATION = Location()
SPECTRUM = Spectrum()
SELECTION = Selection()
CONFIDENCE = Confidence()
LOADS = Loads()
WIND = Wind()
ACCELEROMETER = Accelerometer()
ROTOR_RESPONSE = RotorResponse()
PREDICTION = Prediction()
