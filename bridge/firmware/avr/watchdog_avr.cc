// See watchdog_avr.h.
#include "watchdog_avr.h"

#include <avr/io.h>
#include <avr/wdt.h>
#include <stdint.h>

namespace {

// Not among the variables that the start sets to 0: it is written before that.
__attribute__((section(".noinit"))) uint8_t reset_cause;
__attribute__((section(".noinit"))) uint8_t reset_cause_of_bootloader;

}  // namespace

// Runs before anything else: after its own reset the watchdog is still on, at 16 ms. Bootloaders of the Optiboot family clear
// MCUSR and leave what it was in r2.
extern "C" __attribute__((naked, used, section(".init3"))) void note_reset_cause() {
    __asm__ __volatile__("sts %0, r2" : "=m"(reset_cause_of_bootloader));
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

namespace carril {

bool watchdog_has_bitten() {
    // r2 may hold anything when there is no such bootloader; but then MCUSR holds the cause.
    const bool by_bootloader = reset_cause == 0 && (reset_cause_of_bootloader & 0xF0) == 0;
    return ((by_bootloader ? reset_cause_of_bootloader : reset_cause) & _BV(WDRF)) != 0;
}

void watchdog_begin() { wdt_enable(WDTO_60MS); }

void watchdog_kick() { wdt_reset(); }

}  // namespace carril
