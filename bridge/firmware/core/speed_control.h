// Holds a speed: a PI controller with feed-forward, in integers. Set point, measured speed and time in, duty out. When it holds a
// speed, it never drives a wheel one way while that still turns the other way.
#pragma once

#include "calibration.h"
#include "numbers.h"

namespace carril {

// Duties are signed, + forward, in 1/1020 of full duty. 0 is the brake.
class SpeedControl {
public:
    // 1 or -1: where the motor pushes, or last pushed.
    int8_t direction() const { return direction_; }

    // The motor has been stopped: begins anew.
    void reset();

    // What the motor driver shall do to reach `target_mm_s`. `wheel_mm_s` is never negative; `rolling` is 1 or -1, where the
    // wheel turns. `step_us` is the time since the last step of the chip's control, at most 50 ms.
    int16_t hold(int32_t target_mm_s, int16_t wheel_mm_s, int8_t rolling, uint32_t step_us, const Calibration& calibration);
    // The duty itself is ordered.
    int16_t push(int16_t duty);

private:
    void follow(int32_t target_mm_s, uint32_t step_us, const Calibration& calibration);
    void forget();

    // The target, or on the way there at the permitted acceleration, µm/s: a fine unit, for small steps.
    int32_t set_point_um_s_ = 0;
    // Millionths of 1/1020.
    int32_t integral_ = 0;
    int8_t direction_ = 1;
    // The step before was a step of the controller, too.
    bool stepped_ = false;
};

}  // namespace carril
