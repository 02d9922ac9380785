/* Three drives served by libmodbus, for the cross-check of the rig. Addresses, bits and
 * opcodes are typed in from the makers' manuals, not from rig/maps.
 *
 * slave tcp PORT [FAMILY] | slave rtu DEVICE [FAMILY]
 * FAMILY: leadshine, oriental (AZ) or applied (SCL table), to be enabled first; without
 * it they are leadshine drives, enabled.
 * Prints "ready", then "enable UNIT", "move UNIT PULSES" and "stop UNIT" as commanded.
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { UNITS = 3, REGISTERS = 0x7000 };
static const double RATE = 50000.0;      /* pulses a second: 180 degrees of a joint */

typedef struct {
    const char *name;
    int status;              /* register that holds the bits */
    int off, idle, moving;   /* its word before enabling, at rest, on the way */
    int position;            /* high word; the low one follows */
    int target;
} family_t;

static const family_t families[] = {
    {"leadshine", 0x1003, 0x30, 0x32, 0x06, 0x602C, 0x6201},
    {"oriental", 0x007F, 0x4020, 0x4020, 0x2000, 0x00CC, 0x005C},
    {"applied", 0x0001, 0x0008, 0x0009, 0x0011, 0x0006, 0x001E},
};
static const family_t *family = families;
static modbus_mapping_t *drive[UNITS + 1];
static int32_t start[UNITS + 1], target[UNITS + 1];
static double begun[UNITS + 1]; /* of a move, seconds; 0 at rest */

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static int32_t position(int unit) {
    uint16_t *r = drive[unit]->tab_registers;
    return (int32_t)((uint32_t)r[family->position] << 16 | r[family->position + 1]);
}

/* Where it has come to; at rest there. */
static void move(int unit) {
    uint16_t *r = drive[unit]->tab_registers;
    if (begun[unit] == 0.0) return;
    double way = (double)target[unit] - start[unit], gone = RATE * (now() - begun[unit]);
    int there = gone >= (way < 0 ? -way : way);
    int32_t at = there ? target[unit] : start[unit] + (int32_t)(way < 0 ? -gone : gone);
    r[family->position] = (uint32_t)at >> 16;
    r[family->position + 1] = (uint32_t)at & 0xFFFF;
    if (there) begun[unit] = 0.0, r[family->status] = family->idle;
}

static void go(int unit) {
    uint16_t *r = drive[unit]->tab_registers;
    if (r[family->status] == family->off && family->off != family->idle) return;
    target[unit] = (int32_t)((uint32_t)r[family->target] << 16 | r[family->target + 1]);
    start[unit] = position(unit);
    begun[unit] = now();
    r[family->status] = family->moving;
    printf("move %d %d\n", unit, (int)target[unit]);
}

static void rest(int unit, const char *word) {
    move(unit);
    begun[unit] = 0.0;
    drive[unit]->tab_registers[family->status] = family->idle;
    printf("%s %d\n", word, unit);
}

static void act(int unit, const uint8_t *pdu) {
    uint16_t *r = drive[unit]->tab_registers;
    int function = pdu[0], address = pdu[1] << 8 | pdu[2], last = address;
    if (function == 16) last += (pdu[3] << 8 | pdu[4]) - 1;
    if (function == 3) {
        move(unit);
    } else if (family == &families[0]) {
        /* PR0: mode at 6200h, 1 = absolute; 6207h = 10h runs it; 6002h = 40h stops */
        if (function == 16 && last == 0x6207 && r[0x6207] == 0x10 && r[0x6200] == 1)
            go(unit);
        if (address == 0x6002 && r[0x6002] == 0x40) rest(unit, "stop");
        if (address == 0x000F && r[0x000F] == 1) rest(unit, "enable");
    } else if (family == &families[1]) {
        /* direct data: type at 5Ah/5Bh, 1 = absolute; trigger 66h/67h; STOP: bit 5 */
        if (function == 16 && address == 0x58 && last == 0x67 && !r[0x5A] &&
            r[0x5B] == 1 && r[0x67] == 1)
            go(unit);
        if (address == 0x7D && r[0x7D] & 0x20) rest(unit, "stop");
    } else if (address == 124) {
        /* opcode at 40125: 67h feed to position, E1h stop and kill, 9Fh motor enable */
        if (r[124] == 0x67) go(unit);
        if (r[124] == 0xE1) rest(unit, "stop");
        if (r[124] == 0x9F) rest(unit, "enable");
    }
    fflush(stdout);
}

int main(int argc, char **argv) {
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    if (argc < 3) return 2;
    int tcp = strcmp(argv[1], "tcp") == 0;
    for (size_t i = 0; argc > 3 && i < sizeof families / sizeof *families; i++)
        if (strcmp(argv[3], families[i].name) == 0) family = &families[i];
    for (int unit = 1; unit <= UNITS; unit++) {
        drive[unit] = modbus_mapping_new(0, 0, REGISTERS, 0);
        if (!drive[unit]) return 1;
        drive[unit]->tab_registers[family->status] = argc > 3 ? family->off : family->idle;
        if (family == families) drive[unit]->tab_registers[1] = 10000;
    }
    modbus_t *bus = tcp ? modbus_new_tcp("127.0.0.1", atoi(argv[2]))
                        : modbus_new_rtu(argv[2], 115200, 'N', 8, 1);
    if (!bus) return 1;
    if (!tcp) modbus_set_slave(bus, 1);
    int listener = tcp ? modbus_tcp_listen(bus, 1) : -1;
    if (tcp && listener < 0) return 1;
    if (!tcp && modbus_connect(bus) < 0) return 1;
    printf("ready\n");
    fflush(stdout);
    int header = modbus_get_header_length(bus);
    for (;;) {
        if (tcp && modbus_tcp_accept(bus, &listener) < 0) return 1;
        for (;;) {
            int length = modbus_receive(bus, query);
            if (length < 0 && (tcp || errno == EIO || errno == EBADF)) break;
            if (length <= 0) continue;
            int unit = query[header - 1];
            if (unit < 1 || unit > UNITS) continue;
            if (query[header] == 3) act(unit, query + header);
            modbus_reply(bus, query, length, drive[unit]);
            if (query[header] != 3) act(unit, query + header);
        }
        modbus_close(bus);
        if (!tcp) return 0;
    }
}
