// The watchdog, and why the chip was reset. Once on, it is never turned off.
#pragma once

namespace carril {

// The last reset was the watchdog's.
bool watchdog_has_bitten();
// From now on, `watchdog_kick` must come every 60 ms.
void watchdog_begin();
void watchdog_kick();

}  // namespace carril
