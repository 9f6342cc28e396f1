// The serial port: 500 000 baud, 8N1, a ring of bytes each way, filled and emptied in interrupts. Never waits: what finds no room
// is refused (sent) or lost (received; the checksum finds it).
#pragma once

#include <stdint.h>

namespace carril {

void uart_begin();
// Takes up to `most` bytes that have come; gives their number.
uint8_t uart_read(uint8_t* bytes, uint8_t most);
// All of it or, when there is no room for all, nothing.
bool uart_send(const uint8_t* bytes, uint8_t size);

}  // namespace carril
