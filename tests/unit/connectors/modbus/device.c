/* A Modbus TCP device for tests, made with libmodbus: units 1 and 2 with WORDS entries in each table.
 *
 * It prints its port, and then answers each line on standard input with a line:
 *   set UNIT TABLE ADDRESS VALUE...   (tables: c, d, i, h)
 *   get UNIT TABLE ADDRESS COUNT
 *   calls                             (function, address and count of each request since the last time)
 *   count ADDRESS BYTES               (from now on, count up in these words of table h of unit 1; see below)
 *   slow MS                           (wait so long before each answer)
 * It ends with its standard input.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define WORDS 2000
#define UNITS 2
#define CLIENTS 16

static modbus_mapping_t *units[UNITS];
static char calls[1 << 20];
static size_t calls_length;
static int counted_from = -1, counted, flags = -1, slow_ms;
static unsigned generation;

static void note(const uint8_t *request, int length)
{
    int function = request[7], address = request[8] << 8 | request[9], count = 1;
    if (length >= 12 && function != 5 && function != 6 && function != 22) count = request[10] << 8 | request[11];
    if (calls_length + 64 < sizeof calls)
        calls_length += (size_t)sprintf(calls + calls_length, "%d %d %d;", function, address, count);
}

/* All counted words have the same number; the word after them counts in its upper bits, and a copy follows it. */
static void count_up(void)
{
    if (counted_from < 0) return;
    uint16_t *words = units[0]->tab_registers;
    generation = (generation + 1) & 0x7FFF;
    for (int i = 0; i < counted; i++) words[counted_from + i] = (uint16_t)generation;
    words[flags] = (uint16_t)(((words[flags] + 2) & 0xFE) | (words[flags] & 1));
    words[flags + 1] = words[flags] & 0xFE;
}

static void command(char *line)
{
    int unit, address, count, used;
    char table;
    if (sscanf(line, "set %d %c %d%n", &unit, &table, &address, &used) == 3) {
        modbus_mapping_t *map = units[unit - 1];
        char *rest = line + used;
        for (long value; (value = strtol(rest, &rest, 10)), *rest == ' ' || *rest == '\n'; address++) {
            if (table == 'c') map->tab_bits[address] = (uint8_t)value;
            if (table == 'd') map->tab_input_bits[address] = (uint8_t)value;
            if (table == 'i') map->tab_input_registers[address] = (uint16_t)value;
            if (table == 'h') map->tab_registers[address] = (uint16_t)value;
            if (*rest == '\n') break;
        }
        puts("ok");
    } else if (sscanf(line, "get %d %c %d %d", &unit, &table, &address, &count) == 4) {
        modbus_mapping_t *map = units[unit - 1];
        for (int i = address; i < address + count; i++)
            printf("%d ", table == 'c'   ? map->tab_bits[i]
                          : table == 'd' ? map->tab_input_bits[i]
                          : table == 'i' ? map->tab_input_registers[i]
                                         : map->tab_registers[i]);
        puts("");
    } else if (sscanf(line, "count %d %d", &address, &count) == 2) {
        counted_from = address, counted = count, flags = address + count;
        count_up();
        puts("ok");
    } else if (sscanf(line, "slow %d", &slow_ms) == 1) {
        puts("ok");
    } else {
        printf("%.*s\n", (int)calls_length, calls);
        calls_length = 0;
    }
    fflush(stdout);
}

int main(void)
{
    struct pollfd polled[CLIENTS + 2] = {{.fd = 0, .events = POLLIN}};
    modbus_t *modbus = modbus_new_tcp("127.0.0.1", 0);
    for (int i = 0; i < UNITS; i++) units[i] = modbus_mapping_new(WORDS, WORDS, WORDS, WORDS);
    int listener = modbus_tcp_listen(modbus, CLIENTS), clients = 0;
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    if (listener < 0 || getsockname(listener, (struct sockaddr *)&address, &size)) return 1;
    printf("%d\n", ntohs(address.sin_port));
    fflush(stdout);
    polled[1] = (struct pollfd){.fd = listener, .events = POLLIN};
    for (;;) {
        if (poll(polled, (nfds_t)clients + 2, counted_from < 0 ? -1 : 1) < 0 && errno != EINTR) return 1;
        count_up();
        if (polled[0].revents) {
            char line[1 << 16];
            ssize_t got = read(0, line, sizeof line - 1); /* the test waits for each answer */
            if (got <= 0) return 0;
            line[got] = 0;
            command(line);
        }
        if (polled[1].revents && clients < CLIENTS)
            polled[2 + clients++] = (struct pollfd){.fd = accept(listener, NULL, NULL), .events = POLLIN};
        for (int i = 2; i < clients + 2; i++) {
            uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
            if (!polled[i].revents) continue;
            modbus_set_socket(modbus, polled[i].fd);
            int length = modbus_receive(modbus, request);
            if (length > 0) {
                int unit = request[6];
                note(request, length);
                if (slow_ms) usleep((useconds_t)slow_ms * 1000);
                if (unit >= 1 && unit <= UNITS)
                    modbus_reply(modbus, request, length, units[unit - 1]);
                else
                    modbus_reply_exception(modbus, request, MODBUS_EXCEPTION_GATEWAY_TARGET);
            } else if (length < 0) {
                close(polled[i].fd);
                polled[i--] = polled[1 + clients--];
            }
        }
    }
}
