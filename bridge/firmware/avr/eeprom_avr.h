// One byte of the EEPROM at a time. Never waits for a write to end: ask `eeprom_ready` first.
#pragma once

#include <stdint.h>

namespace carril {

bool eeprom_ready();
uint8_t eeprom_read(uint16_t address);
void eeprom_write(uint16_t address, uint8_t byte);

}  // namespace carril
