// CRC-16/IBM-3740 (CCITT-FALSE): polynomial 0x1021, begins with 0xFFFF, not reflected. Byte by byte and without a table, which
// would take half a KiB of flash. Never keeps state.
#pragma once

#include <stdint.h>

namespace carril {

constexpr uint16_t CRC_START = 0xFFFF;

// The eight shifts of the polynomial for one byte, folded; all in bytes, because the AVR shifts longer numbers bit by bit.
inline uint16_t crc16(uint16_t crc, uint8_t byte) {
    const uint8_t low = static_cast<uint8_t>(crc);
    uint8_t top = static_cast<uint8_t>((crc >> 8) ^ byte);
    top = static_cast<uint8_t>(top ^ (top >> 4));
    const uint8_t new_top = static_cast<uint8_t>(low ^ static_cast<uint8_t>(top << 4) ^ (top >> 3));
    const uint8_t new_low = static_cast<uint8_t>(top ^ static_cast<uint8_t>(top << 5));
    return static_cast<uint16_t>(new_top << 8 | new_low);
}

inline uint16_t crc16(const uint8_t* bytes, uint8_t size) {
    uint16_t crc = CRC_START;
    for (uint8_t i = 0; i < size; ++i) crc = crc16(crc, bytes[i]);
    return crc;
}

}  // namespace carril
