// See eeprom_avr.h.
#include "eeprom_avr.h"

#include <avr/io.h>
#include <util/atomic.h>

namespace carril {

bool eeprom_ready() { return (EECR & _BV(EEPE)) == 0; }

uint8_t eeprom_read(uint16_t address) {
    EEAR = address;
    EECR |= _BV(EERE);
    return EEDR;
}

void eeprom_write(uint16_t address, uint8_t byte) {
    EEAR = address;
    EEDR = byte;
    // The second bit must follow the first within four cycles.
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        EECR |= _BV(EEMPE);
        EECR |= _BV(EEPE);
    }
}

}  // namespace carril
