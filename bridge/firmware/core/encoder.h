// The wheel as its encoder shows it: ticks and their times in, speed out. Without channel B it does not know which way the wheel
// turns. Never reads a clock or a pin.
#pragma once

#include "calibration.h"
#include "numbers.h"

namespace carril {

// What the edges of the encoder's pin have left behind.
struct EncoderReading {
    // Edges since the chip started; wraps.
    uint32_t ticks;
    uint32_t last_tick_us;
    // Between the last two ticks; right when these were less than 8 s apart.
    uint32_t period_us;
    // From channel B at the last edge.
    bool backwards;
};

class Encoder {
public:
    // To be called often: at least every 8 s.
    void read(const EncoderReading& reading, uint32_t now_us);
    // To be called in every step of the control, after `read`: takes the mean over the ticks since the step before.
    void measure(uint32_t now_us, int32_t tick_nm);

    uint32_t ticks() const { return ticks_; }
    const Moment& last_tick() const { return last_tick_; }
    // The time between the last two ticks is known, and the wheel turns.
    bool has_period(uint32_t now_us) const { return has_period_ && !standing(now_us); }
    uint32_t period_us() const { return period_us_; }
    // Of the road under the wheel, as of the last `measure`. Never negative.
    int16_t speed_mm_s() const { return speed_mm_s_; }

private:
    bool standing(uint32_t now_us) const;

    uint32_t ticks_ = 0;
    Moment last_tick_;
    uint32_t last_tick_us_ = 0;
    uint32_t period_us_ = 0;
    bool has_period_ = false;

    // As of the last `measure`.
    uint32_t measured_ticks_ = 0;
    uint32_t measured_tick_us_ = 0;
    // The wheel stood, so that there is no tick to measure from.
    bool stood_ = true;
    // Between two ticks, 1/16 µs: fine enough at 20 000 ticks a second.
    uint32_t mean_period_16_ = 0;
    int16_t speed_mm_s_ = 0;
};

}  // namespace carril
