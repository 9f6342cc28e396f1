// Holds a speed: a PI controller with feed-forward, in integers. Set point, measured speed and time in, duty out. Never drives a
// wheel one way while it still turns the other way.
#pragma once

#include "calibration.h"
#include "numbers.h"

namespace carril {

// Duties are signed, + forward, in 1/1020 of full duty. 0 is the brake.
class SpeedControl {
public:
    // 1 or -1: where the motor pushes, or last pushed.
    int8_t direction() const { return direction_; }

    // Forgets what it has learnt; the wheel stands or brakes.
    void reset();

    // What the motor driver shall do to reach `target_mm_s`. `wheel_mm_s` is never negative; `rolling` is 1 or -1, where the
    // wheel turns.
    int16_t hold(int32_t target_mm_s, int16_t wheel_mm_s, int8_t rolling, uint32_t now_us, const Calibration& calibration);
    // The duty itself is ordered. It obeys the same rule about turning back.
    int16_t push(int16_t duty, int16_t wheel_mm_s, int8_t rolling);

private:
    bool must_brake(int8_t wanted, int16_t wheel_mm_s, int8_t rolling) const;
    uint32_t elapsed_us(uint32_t now_us);
    void follow(int32_t target_mm_s, uint32_t elapsed_us, const Calibration& calibration);

    // Up to the wanted speed, at the permitted acceleration, µm/s: a fine unit, for small accelerations in small steps.
    int32_t set_point_um_s_ = 0;
    // Millionths of 1/1020.
    int32_t integral_ = 0;
    int8_t direction_ = 1;
    uint32_t last_step_us_ = 0;
    bool stepped_ = false;
};

}  // namespace carril
