// What differs from car to car: names, ranges and defaults of the parameters. bridge/vectors/parameters.txt has the same table,
// and the tests compare the two. Checks single values only; whether two of them go together is the host's business.
#pragma once

#include <stdint.h>

namespace carril {

enum class Parameter : uint8_t {
    servo_pin,
    servo_right_us,
    servo_center_us,
    servo_left_us,
    steering_limit_tenth_mrad,
    motor_pwm_pin,
    motor_direction_pin,
    motor_reset_pin,
    motor_forward_level,
    full_duty_speed_mm_s,
    encoder_pin,
    encoder_b_pin,
    encoder_tick_nm,
    speed_p,
    speed_i,
    speed_i_limit,
    lease_ramp_ms,
    acceleration_mm_s2,
    motor_dead_duty,
    battery_pin,
    battery_full_scale_mv,
    battery_low_mv,
    estop_pin,
    estop_pressed_level,
};

constexpr uint8_t PARAMETERS = 24;
// In place of a pin: there is none.
constexpr uint8_t NO_PIN = 255;
// The last pin that can be switched, A5; the two after it only measure.
constexpr uint8_t LAST_DIGITAL_PIN = 19;
constexpr uint8_t FIRST_ANALOG_PIN = 14;
constexpr uint8_t LAST_ANALOG_PIN = 21;

// `index` must be below PARAMETERS.
int32_t parameter_default(uint8_t index);
// Whether the parameter may have this value: within its range, and of a pin that exists.
bool parameter_allows(uint8_t index, int32_t value);

}  // namespace carril
