/* Three Leadshine-type drives served by libmodbus, for the cross-check of the rig.
 *
 * slave tcp PORT | slave rtu DEVICE
 * Prints "ready", then "move UNIT PULSES" and "stop UNIT" as they are commanded.
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { UNITS = 3, REGISTERS = 0x7000, STATUS = 0x1003, MOVE = 0x6200, TRIGGER = 0x6002,
       POSITION = 0x602C, IDLE = 0x32, MOVING = 0x06, POLLS = 2 };

static modbus_mapping_t *drive[UNITS + 1];
static int32_t target[UNITS + 1];
static int busy[UNITS + 1];

static void set_position(int unit, int32_t pulses) {
    drive[unit]->tab_registers[POSITION] = (uint32_t)pulses >> 16;
    drive[unit]->tab_registers[POSITION + 1] = (uint32_t)pulses & 0xFFFF;
}

static void act(int unit, const uint8_t *pdu) {
    uint16_t *r = drive[unit]->tab_registers;
    int address = pdu[1] << 8 | pdu[2];
    if (pdu[0] == 3 && address == STATUS && busy[unit] > 0 && --busy[unit] == 0) {
        set_position(unit, target[unit]);
        r[STATUS] = IDLE;
    }
    if (pdu[0] == 16 && address == MOVE && r[MOVE + 7] == 0x10) {
        target[unit] = (int32_t)((uint32_t)r[MOVE + 1] << 16 | r[MOVE + 2]);
        busy[unit] = POLLS;
        r[STATUS] = MOVING;
        printf("move %d %d\n", unit, (int)target[unit]);
    }
    if (pdu[0] == 6 && address == TRIGGER && r[TRIGGER] == 0x40) {
        busy[unit] = 0;
        r[STATUS] = IDLE;
        printf("stop %d\n", unit);
    }
    fflush(stdout);
}

int main(int argc, char **argv) {
    int tcp = argc == 3 && strcmp(argv[1], "tcp") == 0;
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    if (argc != 3) return 2;
    for (int unit = 1; unit <= UNITS; unit++) {
        drive[unit] = modbus_mapping_new(0, 0, REGISTERS, 0);
        if (!drive[unit]) return 1;
        drive[unit]->tab_registers[STATUS] = IDLE;
        drive[unit]->tab_registers[1] = 10000;
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
