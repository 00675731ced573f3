/* Copyright 2026 the adxl_ros authors
 *
 * Licensed under the Apache License, Version 2.0 (the "License");
 * you may not use this file except in compliance with the License.
 * You may obtain a copy of the License at
 *
 *     http://www.apache.org/licenses/LICENSE-2.0
 *
 * Unless required by applicable law or agreed to in writing, software
 * distributed under the License is distributed on an "AS IS" BASIS,
 * WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
 * See the License for the specific language governing permissions and
 * limitations under the License.
 */

/* Frames of the serial wire format, version 1, of adxl_ros: plain C99, no heap, no globals.
 *
 * A frame is COBS(payload, CRC-32) and one 0x00; everything is little-endian, whatever the
 * processor is. docs/links.md has the fields. */

#ifndef ADXL_FRAME_H
#define ADXL_FRAME_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { FRAME_RAIL = 1, FRAME_AFTER_RESET = 2 };

/* What the board counts; all zero, but for flags = FRAME_AFTER_RESET, after a reset. */
struct frame_counts {
    uint32_t block_seq;
    uint16_t flags;
};

/* Room that a frame of n samples of m channels takes at most, its 0x00 included. */
#define FRAME_ROOM(n, m) (24 + 2 * (n) * (m) + 4 + (28 + 2 * (n) * (m)) / 254 + 2)

/* Write a data frame; returns its length in bytes.
 * codes: nsamp * nch ADC codes, right-aligned, sample after sample; bits: of the ADC. */
size_t frame_data(struct frame_counts *counts, uint64_t t_dev_us, uint32_t first_index,
                  uint16_t overruns, uint8_t nsamp, uint8_t nch, const uint16_t *codes,
                  uint8_t bits, uint8_t *out);

/* Write an info frame; returns its length in bytes. serial: up to 16 ASCII characters. */
size_t frame_info(struct frame_counts *counts, float rate_hz, uint8_t bits, uint8_t nch,
                  float vref_v, const char *serial, uint8_t *out);

#ifdef __cplusplus
}
#endif

#endif
