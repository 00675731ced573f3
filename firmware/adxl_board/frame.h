// SPDX-License-Identifier: Apache-2.0

/* Frames of the serial wire format of adxl_ros, version 1: plain C99, no heap, no globals.
 *
 * A frame is COBS(payload, CRC-32) and one 0x00. All numbers are little-endian on every processor.
 * docs/reference/wire_format.md has the fields. */

#ifndef ADXL_FRAME_H
#define ADXL_FRAME_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Flags. The last two are of a board that switches the self-test of its sensor. */
enum { FRAME_RAIL = 1, FRAME_AFTER_RESET = 2, FRAME_IN_SELF_TEST = 4, FRAME_HAS_SELF_TEST = 8 };

/* Commands of the host. */
enum { FRAME_LATENCY = 3, FRAME_SELF_TEST = 4 };

/* Counts of the board. After a reset: block_seq = 0, flags = FRAME_AFTER_RESET. */
struct frame_counts {
    uint32_t block_seq; /* number of the next frame */
    uint16_t flags;     /* flags of the next frame */
};

/* Size of a command of the host in bytes, without its 0x00. */
#define FRAME_COMMAND_ROOM 17

/* A command of the host that has come in part. After a reset: all 0. */
struct frame_receiver {
    uint8_t raw[FRAME_COMMAND_ROOM]; /* bytes since the last 0x00 */
    uint8_t length;                  /* their number; more than FRAME_COMMAND_ROOM: too many */
};

/* Largest size of a frame of n samples of m channels in bytes, its 0x00 included. */
#define FRAME_ROOM(n, m) (24 + 2 * (n) * (m) + 4 + (28 + 2 * (n) * (m)) / 254 + 2)

/* Write a data frame; return its length in bytes.
 * t_dev_us: device clock at the first sample. first_index: its number, dropped samples included.
 * overruns: samples dropped since the reset. nsamp, nch: numbers of samples and channels.
 * codes: nsamp * nch ADC codes, right-aligned, sample after sample. bits: resolution of the ADC.
 * out: FRAME_ROOM(nsamp, nch) bytes. */
size_t frame_data(struct frame_counts *counts, uint64_t t_dev_us, uint32_t first_index,
                  uint16_t overruns, uint8_t nsamp, uint8_t nch, const uint16_t *codes,
                  uint8_t bits, uint8_t *out);

/* Write an info frame; return its length in bytes.
 * rate_hz: sample rate. bits, vref_v: resolution and reference voltage of the ADC. nch: number of
 * channels. serial: up to 16 ASCII characters. out: 48 bytes. */
size_t frame_info(struct frame_counts *counts, float rate_hz, uint8_t bits, uint8_t nch,
                  float vref_v, const char *serial, uint8_t *out);

/* Take one byte from the host; return the command that it completes, else 0.
 * time_us: gets its time. FRAME_LATENCY: the longest over which the samples of a frame shall be
 * collected. FRAME_SELF_TEST: for how long the self-test shall be on from now, 0 to end it. */
int frame_command(struct frame_receiver *receiver, uint8_t byte, uint32_t *time_us);

/* Return how many samples are collected within latency_us: 1 to most. */
uint8_t frame_samples(uint32_t latency_us, float rate_hz, uint8_t most);

#ifdef __cplusplus
}
#endif

#endif
