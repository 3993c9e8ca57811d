/* A Modbus slave on libmodbus, for the tests of the Modbus driver.
 *
 *   modbus_slave tcp FIRST_PORT        listens on 127.0.0.1, prints "PORT n"
 *   modbus_slave rtu DEVICE SLAVE      answers on a serial device at 19200 baud, no parity, prints "READY"
 *
 * Input and holding registers k hold 200 + k; holding registers 100 and 101 hold the float 36.6, high word first;
 * holding register 10 counts the requests. It ends when its standard input is closed.
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { REGISTERS = 128, FLOAT_AT = 100, COUNTER_AT = 10 };

static int answer(modbus_t *context, modbus_mapping_t *map)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int length = modbus_receive(context, query);
    if (length > 0) {
        map->tab_registers[COUNTER_AT]++;
        return modbus_reply(context, query, length, map);
    }
    return length;
}

/* 1: a request is there; 0: the tests are done with us. */
static int wait_for(int descriptor)
{
    struct pollfd both[2] = {{.fd = descriptor, .events = POLLIN}, {.fd = STDIN_FILENO, .events = POLLIN}};
    if (poll(both, 2, -1) < 0 || both[1].revents)
        return 0;
    return 1;
}

static int serve_tcp(const char *first_port, modbus_mapping_t *map)
{
    int port = atoi(first_port), listener = -1;
    modbus_t *context = NULL;
    for (int k = 0; k < 100 && listener < 0; k++) {
        context = modbus_new_tcp("127.0.0.1", port + k);
        listener = modbus_tcp_listen(context, 1);
        if (listener >= 0)
            printf("PORT %d\n", port + k);
        else
            modbus_free(context);
    }
    fflush(stdout);
    while (listener >= 0 && wait_for(listener)) {
        modbus_tcp_accept(context, &listener);
        while (wait_for(modbus_get_socket(context)))
            if (answer(context, map) < 0)
                break;
        modbus_close(context);
    }
    return 0;
}

static int serve_rtu(const char *device, const char *slave, modbus_mapping_t *map)
{
    /* modbus_receive takes what follows another slave's request for its answer, and gets out of step: flush then. */
    modbus_t *context = modbus_new_rtu(device, 19200, 'N', 8, 1);
    if (context == NULL || modbus_set_slave(context, atoi(slave)) < 0 || modbus_connect(context) < 0) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    puts("READY");
    fflush(stdout);
    while (wait_for(modbus_get_socket(context)))
        if (answer(context, map) <= 0)
            modbus_flush(context);
    return 0;
}

int main(int count, char **words)
{
    modbus_mapping_t *map = modbus_mapping_new(0, 0, REGISTERS, REGISTERS);
    for (int k = 0; k < REGISTERS; k++)
        map->tab_registers[k] = map->tab_input_registers[k] = 200 + k;
    map->tab_registers[COUNTER_AT] = 0;
    /* By hand: what modbus_set_float_abcd writes differs between releases. */
    const float number = 36.6f;
    uint32_t bits;
    memcpy(&bits, &number, sizeof bits);
    map->tab_registers[FLOAT_AT] = bits >> 16;
    map->tab_registers[FLOAT_AT + 1] = bits & 0xFFFF;
    if (count == 3 && strcmp(words[1], "tcp") == 0)
        return serve_tcp(words[2], map);
    if (count == 4 && strcmp(words[1], "rtu") == 0)
        return serve_rtu(words[2], words[3], map);
    return 2;
}
