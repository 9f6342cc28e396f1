// See parameters.h.
#include "parameters.h"

#include "flash.h"

namespace carril {

namespace {

struct Range {
    int32_t minimum;
    int32_t maximum;
    int32_t usual;
};

// In the order of Parameter. Units, and what each is for: bridge/protocol.md.
const Range RANGES[PARAMETERS] CARRIL_IN_FLASH = {
    {2, 19, 9},                    // servo_pin
    {500, 2500, 635},              // servo_right_us
    {500, 2500, 1050},             // servo_center_us
    {500, 2500, 1465},             // servo_left_us
    {100, 7854, 3491},             // steering_limit_tenth_mrad
    {3, 11, 11},                   // motor_pwm_pin
    {2, 19, 4},                    // motor_direction_pin
    {2, 255, 7},                   // motor_reset_pin
    {0, 1, 1},                     // motor_forward_level
    {100, 20000, 2000},            // full_duty_speed_mm_s
    {2, 3, 2},                     // encoder_pin
    {2, 255, 255},                 // encoder_b_pin
    {1000, 100000000, 1570796},    // encoder_tick_nm
    {0, 20000, 255},               // speed_p
    {0, 20000, 1020},              // speed_i
    {0, 1020, 408},                // speed_i_limit
    {0, 1000, 0},                  // lease_ramp_ms
    {0, 20000, 0},                 // acceleration_mm_s2
    {0, 500, 0},                   // motor_dead_duty
    {14, 255, 14},                 // battery_pin
    {1000, 60000, 15000},          // battery_full_scale_mv
    {0, 60000, 6400},              // battery_low_mv
    {2, 255, 8},                   // estop_pin
    {0, 1, 0},                     // estop_pressed_level
};

bool pin_exists(Parameter parameter, int32_t pin) {
    switch (parameter) {
        // The pins that a timer of 8 bits can drive at 7.8 kHz.
        case Parameter::motor_pwm_pin: return pin == 3 || pin == 5 || pin == 6 || pin == 11;
        case Parameter::battery_pin: return pin <= LAST_ANALOG_PIN || pin == NO_PIN;
        case Parameter::motor_reset_pin:
        case Parameter::encoder_b_pin:
        case Parameter::estop_pin: return pin <= LAST_DIGITAL_PIN || pin == NO_PIN;
        default: return true;
    }
}

}  // namespace

int32_t parameter_default(uint8_t index) { return from_flash(RANGES[index].usual); }

bool parameter_allows(uint8_t index, int32_t value) {
    const Range& range = RANGES[index];
    return value >= from_flash(range.minimum) && value <= from_flash(range.maximum) &&
           pin_exists(static_cast<Parameter>(index), value);
}

}  // namespace carril
