// Constants that stay in flash. On the AVR, flash is another address space than RAM, and a plain constant array would take
// RAM; on the host this is plain memory. Never holds anything that changes.
#pragma once

#include <stdint.h>

#ifdef __AVR__
#include <avr/pgmspace.h>
#define CARRIL_IN_FLASH PROGMEM
#else
#define CARRIL_IN_FLASH
#endif

namespace carril {

inline int32_t from_flash(const int32_t& constant) {
#ifdef __AVR__
    return static_cast<int32_t>(pgm_read_dword(&constant));
#else
    return constant;
#endif
}

}  // namespace carril
