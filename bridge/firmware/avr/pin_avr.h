// Arduino's pin numbers and the registers behind them. Never remembers what a pin is for.
#pragma once

#include <avr/io.h>
#include <stdint.h>
#include <util/atomic.h>

#include "../core/parameters.h"

namespace carril {

// One pin; numbers that are no digital pin make a pin that does nothing and reads as low.
class Pin {
public:
    Pin() = default;

    explicit Pin(uint8_t number) {
        if (number > LAST_DIGITAL_PIN) return;
        port_ = number < 8 ? &PORTD : number < 14 ? &PORTB : &PORTC;
        mask_ = static_cast<uint8_t>(1 << (number < 8 ? number : number < 14 ? number - 8 : number - 14));
    }

    bool exists() const { return mask_ != 0; }

    // The level is there before the pin drives it.
    void make_output(bool level) const {
        if (!exists()) return;
        set(level);
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { ddr() |= mask_; }
    }

    void make_input_with_pull_up() const {
        if (!exists()) return;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            ddr() &= static_cast<uint8_t>(~mask_);
            *port_ |= mask_;
        }
    }

    // Other pins of the same port are switched in interrupts: hence no interrupt in between.
    void set(bool level) const {
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { set_in_interrupt(level); }
    }

    // As `set`, for interrupts and where they are off.
    void set_in_interrupt(bool level) const {
        if (level) {
            *port_ |= mask_;
        } else {
            *port_ &= static_cast<uint8_t>(~mask_);
        }
    }

    bool level() const { return (pins() & mask_) != 0; }

private:
    // Of each port, PINx, DDRx and PORTx stand in this order.
    volatile uint8_t& ddr() const { return *(port_ - 1); }
    volatile uint8_t& pins() const { return *(port_ - 2); }

    // GPIOR2 is a register that nothing else uses and that has no effect. The two before it have none with the mask 0.
    volatile uint8_t* port_ = &GPIOR2;
    uint8_t mask_ = 0;
};

}  // namespace carril
