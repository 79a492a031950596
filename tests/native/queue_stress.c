/* One producer and one consumer on a small queue, for the sanitizers. Exit status 0: every record came whole and in order. */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>

#include "../../shmio/segment/queue.h"

enum { CAPACITY = 1024, RECORDS = 60000, LONGEST = 300 };

static uint8_t *queue;
static a32 bell;
static _Atomic int problems;

static uint32_t size_of(uint32_t number) { return number * 7919u % (LONGEST + 1); }

static void *produce(void *unused)
{
    (void)unused;
    uint8_t record[LONGEST];
    for (uint32_t number = 0; number < RECORDS; number++) {
        memset(record, (int)number, sizeof record);
        while (!queue_push(queue, CAPACITY, record, size_of(number))) sched_yield();
        doorbell_ring(&bell);
    }
    return NULL;
}

static void *consume(void *unused)
{
    (void)unused;
    uint8_t record[LONGEST];
    for (uint32_t number = 0; number < RECORDS; number++) {
        uint32_t size = 0;
        enum queue_result result;
        for (;;) {
            uint32_t seen = atomic_load_explicit(&bell, memory_order_acquire);
            result = queue_peek(queue, CAPACITY, &size);
            if (result != QUEUE_EMPTY) break;
            doorbell_wait(&bell, NULL, seen, 1000000000);
        }
        bool right = result == QUEUE_RECORD && size == size_of(number);
        if (right) {
            queue_drop(queue, CAPACITY, record, size);
            for (uint32_t i = 0; i < size; i++) right = right && record[i] == (uint8_t)number;
        }
        if (!right) {
            atomic_fetch_add(&problems, 1);
            fprintf(stderr, "record %u is not what was sent\n", number);
            exit(1);
        }
    }
    return NULL;
}

int main(void)
{
    queue = aligned_alloc(64, QUEUE_HEADER_SIZE + CAPACITY);
    memset(queue, 0, QUEUE_HEADER_SIZE + CAPACITY);
    pthread_t producer, consumer;
    pthread_create(&producer, NULL, produce, NULL);
    pthread_create(&consumer, NULL, consume, NULL);
    pthread_join(producer, NULL);
    pthread_join(consumer, NULL);
    free(queue);
    return atomic_load(&problems) ? 1 : 0;
}
