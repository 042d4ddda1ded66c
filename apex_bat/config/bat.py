"""Settings of the bat and its world: body, sensors, sonar, state and episodes."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from apex_bat.config.sections import Count, CountOrZero, NonNegative, Positive, Section


class Body(Section, frozen=True):
    """The robot and how it moves (thesis ch. 3)."""

    diameter_m: Positive = 0.35
    """Diameter of the cylinder, a kobuki turtlebot."""
    speed_m_s: Positive = 3.0
    """Constant forward speed."""
    turn_rate_deg_s: Positive = 360.0
    """Turn rate of the actions left and right."""
    call_interval_s: Positive = 0.05
    """Time between two calls, which is one step: 20 Hz."""
    sensor_height_m: Positive = 0.4
    """Height of mouth, ears and range sensors above the floor."""
    heading_noise_deg: NonNegative = 0.0
    """Standard deviation of a random turn added at each step. 0 in the thesis."""
    speed_noise: NonNegative = 0.0
    """Standard deviation of the relative error of the speed at each step. 0 in the thesis."""


class Rays(Section, frozen=True):
    """The range sensors. The 3D one feeds the ear, the 2D one the reward (thesis section 3.1)."""

    caster: Literal["embree", "pybullet"] = "embree"
    """Who intersects rays with the bodies: Embree on their meshes, or PyBullet itself (slower)."""
    num_azimuth: Count = 100
    """Columns of the 3D sensor, spread evenly over the azimuth span."""
    num_elevation: Count = 10
    """Rows of the 3D sensor, spread evenly over the elevation span; 100 x 10 = the thesis's 1000 rays."""
    azimuth_span_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 180.0
    """Width of the 3D sensor, centred ahead: -90 to +90 degrees."""
    max_elevation_deg: Annotated[float, Meta(ge=0.0, lt=90.0)] = 30.0
    """The 3D sensor looks from 0 up to this elevation, so that the floor returns no echoes."""
    num_clearance: Count = 360
    """Rays of the 2D sensor, evenly around the robot."""
    max_range_m: Positive = 20.0
    """Farther than this is a miss."""


class Sonar(Section, frozen=True):
    """The call, the air, the reflectors and the ears (thesis section 3.1, eq. 3.1.1)."""

    sample_rate_hz: ClassVar[int] = 125_000
    """Sample rate of the thesis's chain; the frame's 24 ms are 3000 samples of it. Not a setting."""

    rendering: Literal["thesis", "exact"] = "thesis"
    """`thesis`: 125 kHz chain with rounded delays. `exact`: complex baseband with exact delays, cheaper."""
    call_level_db: float = 100.0
    """Level of the call, dB SPL at 0.1 m (thesis eq. 3.1.1)."""
    call_duration_s: Annotated[float, Meta(gt=0.0, le=0.01)] = 0.0025
    """Length of the call (thesis)."""
    call_ramp_samples: CountOrZero = 31
    """Length of the raised-cosine ramps at both ends, in samples of 125 kHz."""
    frequency_hz: Annotated[float, Meta(ge=20_000.0, le=60_000.0)] = 40_000.0
    """Carrier or centre of the sweep, and the cochlea's channel that the frame comes from (thesis)."""
    sweep_hz: float = 0.0
    """Linear FM: the carrier runs over this band, from high to low when negative. 0 is the thesis's tone."""
    absorption_db_m: NonNegative | None = 1.318
    """One-way absorption of air (thesis: 40 kHz, 20 C, 50 % humidity). None: by ISO 9613-1 from the next two."""
    temperature_c: Annotated[float, Meta(ge=-20.0, le=50.0)] | None = None
    """Air temperature for ISO 9613-1; set it together with `humidity_percent` and with `absorption_db_m` None."""
    humidity_percent: Annotated[float, Meta(gt=0.0, le=100.0)] | None = None
    """Relative humidity for ISO 9613-1."""
    speed_of_sound_m_s: Positive = 343.0
    """Speed of sound (thesis)."""
    floor_db: float = 20.0
    """Reflectors below this level at the ear are not heard (thesis)."""
    summation: Literal["coherent", "random_phase", "incoherent"] = "coherent"
    """How echoes of one call add: as pressures (thesis), with a random phase each, or as energies."""
    level_jitter_db: NonNegative = 0.0
    """Standard deviation of a random level added to each reflector at each call. 0 in the thesis."""
    receiver_noise_db: float | None = None
    """White noise at each ear, as loud within the cochlea's channel as a tone of this level, dB SPL. None: no noise
    (thesis)."""
    directivity: Literal["phyllostomus", "piston", "table", "omni"] = "phyllostomus"
    """Mouth and ears together: the fit to Phyllostomus discolor at 40 kHz, a circular piston,
    a user's table, or the same level from everywhere."""
    directivity_table: str = ""
    """For `table`: an .npz with azimuth_rad (a,), elevation_rad (e,), level_db (2, a, e), ears left, right."""
    piston_radius_m: Positive = 0.005
    """For `piston`: its radius; 4, 5, 6, 8 mm give -6 dB half-angles of 49, 37, 30, 22 degrees at 40 kHz."""
    piston_angle_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 31.0
    """For `piston`: how far each ear points outwards."""
    ear_separation_m: NonNegative = 0.0
    """Distance between the ears; each hears its own path length. 0 in the thesis."""

    def __post_init__(self) -> None:
        iso = (self.temperature_c is not None, self.humidity_percent is not None)
        if self.absorption_db_m is None and not all(iso):
            raise ValueError("absorption_db_m is None, so temperature_c and humidity_percent must both be set")
        if self.absorption_db_m is not None and any(iso):
            raise ValueError("temperature_c and humidity_percent do nothing unless absorption_db_m is None")
        if (self.directivity == "table") != bool(self.directivity_table):
            raise ValueError('directivity_table and directivity = "table" belong together')
        if 2 * self.call_ramp_samples > self.call_duration_s * self.sample_rate_hz:
            raise ValueError(
                f"two ramps of {self.call_ramp_samples} samples are longer than a call of {self.call_duration_s} s"
            )
        if abs(self.sweep_hz) >= 2.0 * self.frequency_hz:
            raise ValueError(f"a sweep of {self.sweep_hz} Hz about {self.frequency_hz} Hz passes through zero")

    @property
    def is_random(self) -> bool:
        """Whether equal calls sound different: then each bat needs a random generator."""
        return self.level_jitter_db > 0.0 or self.summation == "random_phase" or self.receiver_noise_db is not None


class Sensing(Section, frozen=True):
    """How echoes become the state that the policy sees (thesis section 3.2)."""

    memory_steps: Annotated[int, Meta(ge=1, le=8)] = 3
    """Echoes in a state, the newest included: its rows are 2 x this (thesis: 3)."""
    onset: Literal["zero", "copy"] = "zero"
    """Condition onset: what stands after the first value above the floor: zeros, or that value (fig. 3.11)."""
    onset_threshold: Positive = 0.0131
    """A cochlea value counts as an onset above this: the greatest value of a 20 dB echo (measured)."""
    action_memory: bool = True
    """Whether the last three actions are part of the state (thesis eq. 3.2.1)."""


class Episode(Section, frozen=True):
    """Reward, counters and ends of an episode (thesis eq. 3.2.2)."""

    near_m: Positive = 0.4
    """Clearance below which a step is damage."""
    near_reward: float = -0.005
    """Reward of a step nearer than `near_m`."""
    straight_reward: float = 0.05
    """Reward of a straight step farther than `near_m`."""
    max_damage: CountOrZero = 3
    """The training episode terminates when more steps than this were near."""
    max_idle: CountOrZero = 10
    """It also terminates when there were more negative rewards than this since the last positive one."""
    training_steps: Count = 300
    """Time limit in training, a truncation."""
    evaluation_steps: Count = 1000
    """Time limit in evaluation: 150 m."""
    safe_start_m: Positive = 0.4
    """Least clearance of a start pose; a way out must exist too."""
    listening_steps: Annotated[int, Meta(ge=0, le=100)] = 2
    """Straight steps from a start after which a way out must still exist; after 2 the memory of 3 echoes is full."""
