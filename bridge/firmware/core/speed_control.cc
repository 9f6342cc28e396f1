// See speed_control.h. bridge/src/speed_control.rs is the same in floating point.
#include "speed_control.h"

#include "frame.h"

namespace carril {

namespace {

// Slower set points mean: stand.
constexpr int32_t STANDSTILL_MM_S = 5;
// A wheel faster than this is not driven the other way: it brakes first.
constexpr int16_t REVERSE_BELOW_MM_S = 100;
// No error counts as larger; it keeps products within 32 bits and is the largest speed that can be told.
constexpr int32_t LARGEST_ERROR_MM_S = 20000;
// Nor does a step's error times its length: 10 m/s for 5 ms.
constexpr int32_t LARGEST_TRAVEL_UM = 50000;
// Sums are made in sixteenths of 1/1020: the PWM has 256 steps, the integral has finer ones.
constexpr int32_t FINE = 16;
constexpr int32_t FULL = FINE * FULL_DUTY;

int8_t sign(int32_t value) { return value < 0 ? -1 : 1; }

}  // namespace

void SpeedControl::reset() {
    forget();
    set_point_um_s_ = 0;
}

// What it has learnt does not hold any more: the wheel stands or brakes.
void SpeedControl::forget() {
    integral_ = 0;
    stepped_ = false;
}

void SpeedControl::follow(int32_t target_mm_s, uint32_t step_us, const Calibration& calibration) {
    const int32_t target_um_s = target_mm_s * 1000;
    const int32_t limit_mm_s2 = calibration[Parameter::acceleration_mm_s2];
    if (limit_mm_s2 == 0) {
        set_point_um_s_ = target_um_s;
        return;
    }
    // mm/s² times µs are nm/s: at most 20 000 times 50 000.
    const int32_t most_um_s = limit_mm_s2 * static_cast<int32_t>(step_us) / 1000;
    set_point_um_s_ += clamp(target_um_s - set_point_um_s_, -most_um_s, most_um_s);
}

int16_t SpeedControl::hold(int32_t target_mm_s, int16_t wheel_mm_s, int8_t rolling, uint32_t step_us,
                           const Calibration& calibration) {
    follow(target_mm_s, step_us, calibration);
    const int8_t wanted = sign(set_point_um_s_);
    const int32_t set_point_mm_s = magnitude(set_point_um_s_) / 1000;
    if (set_point_mm_s < STANDSTILL_MM_S || (wanted != rolling && wheel_mm_s > REVERSE_BELOW_MM_S)) {
        forget();
        return 0;
    }
    direction_ = wanted;
    const int32_t elapsed_us = stepped_ ? static_cast<int32_t>(step_us) : 0;
    stepped_ = true;
    const int32_t error_mm_s = clamp(set_point_mm_s - wheel_mm_s, -LARGEST_ERROR_MM_S, LARGEST_ERROR_MM_S);
    const int32_t feed_forward = FULL * set_point_mm_s / calibration[Parameter::full_duty_speed_mm_s];
    // Of thousandths; 2 / 125 are 16 / 1000, and leave room in 32 bits.
    const int32_t proportional = calibration[Parameter::speed_p] * error_mm_s * 2 / 125;
    const int32_t unlimited = feed_forward + proportional + integral_ / (1000000 / FINE);
    // At a limit the integral only moves back: it does not wind up.
    if ((unlimited < FULL || error_mm_s < 0) && (unlimited > 0 || error_mm_s > 0)) {
        const int32_t travel_um = clamp(error_mm_s * elapsed_us / 1000, -LARGEST_TRAVEL_UM, LARGEST_TRAVEL_UM);
        // At most 1.02e9 each: their sum still fits.
        const int32_t limit = calibration[Parameter::speed_i_limit] * 1000000;
        integral_ = clamp(integral_ + calibration[Parameter::speed_i] * travel_um, -limit, limit);
    }
    const int32_t duty = (clamp<int32_t>(unlimited, 0, FULL) + FINE / 2) / FINE;
    return static_cast<int16_t>(direction_ * duty);
}

int16_t SpeedControl::push(int16_t duty) {
    forget();
    if (duty != 0) direction_ = sign(duty);
    return duty;
}

}  // namespace carril
