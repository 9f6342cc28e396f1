// CRC-16/IBM-3740 (CCITT-FALSE): polynomial 0x1021, begins with 0xFFFF, not reflected. Byte by byte and without a table, which
// would take half a KiB of flash. Never keeps state.
#pragma once

#include <stdint.h>

namespace carril {

constexpr uint16_t CRC_START = 0xFFFF;

inline uint16_t crc16(uint16_t crc, uint8_t byte) {
    // As avr-libc's _crc_xmodem_update: eight shifts of the polynomial folded into four steps.
    crc = static_cast<uint16_t>(static_cast<uint16_t>(crc << 8) | (crc >> 8));
    crc = static_cast<uint16_t>(crc ^ byte);
    crc = static_cast<uint16_t>(crc ^ ((crc & 0xFF) >> 4));
    crc = static_cast<uint16_t>(crc ^ static_cast<uint16_t>(crc << 12));
    crc = static_cast<uint16_t>(crc ^ ((crc & 0xFF) << 5));
    return crc;
}

inline uint16_t crc16(const uint8_t* bytes, uint8_t size) {
    uint16_t crc = CRC_START;
    for (uint8_t i = 0; i < size; ++i) crc = crc16(crc, bytes[i]);
    return crc;
}

}  // namespace carril
