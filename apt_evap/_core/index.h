/* Numbers of atoms, nodes and events, and their counts: 64 bits on every system, where `long` has 32 on some. */
#ifndef APT_EVAP_INDEX_H
#define APT_EVAP_INDEX_H

typedef long long Index;

#endif
