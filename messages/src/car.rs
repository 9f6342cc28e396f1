//! The 1:10 car that carril grew up on: the defaults of operators, bridge and simulator. Other cars say so in their graph file.

/// From axle to axle, m.
pub const WHEELBASE_M: f64 = 0.26;
/// From the middle of the left wheels to the middle of the right wheels, m.
pub const TRACK_WIDTH_M: f64 = 0.165;
/// Width of a wheel, m.
pub const WHEEL_WIDTH_M: f64 = 0.025;
/// The body reaches from here to [`BODY_FRONT_M`], ahead of the rear axle, m: the wheels stand out by their radius, the bumper a bit more.
pub const BODY_REAR_M: f64 = -0.05;
/// Front end of the body, ahead of the rear axle, m.
pub const BODY_FRONT_M: f64 = 0.30;
/// Width of the body, m: over the wheels.
pub const BODY_WIDTH_M: f64 = TRACK_WIDTH_M + WHEEL_WIDTH_M;
/// Of the lidar, ahead of the rear axle, m.
pub const LIDAR_FORWARD_M: f64 = 0.18;
/// Diameter of a wheel, m.
pub const WHEEL_DIAMETER_M: f64 = 0.06;
/// Road-wheel angle at the servo's stops, rad: 20 degrees.
pub const STEERING_LIMIT_RAD: f64 = 0.349_065_850_398_865_9;
/// Servo pulse at the right stop, µs.
pub const SERVO_RIGHT_US: u16 = 635;
/// Servo pulse at the left stop, µs.
pub const SERVO_LEFT_US: u16 = 1465;
/// Edges of the encoder per metre of road: 120 edges per turn of a 6 cm wheel.
pub const ENCODER_TICKS_PER_M: f64 = 120.0 / (std::f64::consts::PI * WHEEL_DIAMETER_M);
/// Speed at full duty on level ground, m/s.
pub const FULL_DUTY_SPEED_M_S: f64 = 2.0;
/// Battery voltage of a full two-cell pack, V.
pub const BATTERY_FULL_V: f64 = 8.4;
/// Below this voltage the car shall not drive, V.
pub const BATTERY_LOW_V: f64 = 6.4;
