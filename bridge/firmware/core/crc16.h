// CRC-16/IBM-3740 (CCITT-FALSE): polynomial 0x1021, begins with 0xFFFF, not reflected. Byte by byte and without a table, which
// would take half a KiB of flash. Never keeps state.
#pragma once

#include <stdint.h>

namespace carril {

constexpr uint16_t CRC_START = 0xFFFF;

// The checksum in two bytes, because the AVR shifts longer numbers bit by bit.
class Crc16 {
public:
    // The eight shifts of the polynomial for one byte, folded.
    void add(uint8_t byte) {
        uint8_t folded = static_cast<uint8_t>(top_ ^ byte);
        folded = static_cast<uint8_t>(folded ^ (folded >> 4));
        top_ = static_cast<uint8_t>(low_ ^ static_cast<uint8_t>(folded << 4) ^ (folded >> 3));
        low_ = static_cast<uint8_t>(folded ^ static_cast<uint8_t>(folded << 5));
    }

    uint16_t value() const { return static_cast<uint16_t>(top_ << 8 | low_); }

private:
    uint8_t top_ = CRC_START >> 8;
    uint8_t low_ = CRC_START & 0xFF;
};

inline uint16_t crc16(const uint8_t* bytes, uint8_t size) {
    Crc16 crc;
    for (uint8_t i = 0; i < size; ++i) crc.add(bytes[i]);
    return crc.value();
}

}  // namespace carril
