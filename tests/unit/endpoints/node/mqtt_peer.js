// A device at an MQTT broker, made with the package mqtt, and a broker made with aedes: neither shares code with ours.
//
// Usage: node mqtt_peer.js; it takes commands on standard input, a JSON list a line, and answers each.
'use strict'

const net = require('net')
const readline = require('readline')
const mqtt = require('mqtt')
const sparkplug = require('sparkplug-payload').get('spBv1.0')

const heard = [] // {topic, payload, retain, qos}
const waiting = [] // {topic, resolve}
let client = null

const payloadOf = given => (typeof given === 'object' && given !== null ? Buffer.from(given.hex, 'hex') : String(given))

// Protobuf.js gives 64-bit numbers as objects.
function plain(value) {
  return JSON.parse(JSON.stringify(value, (_, one) =>
    one !== null && typeof one === 'object' && 'low' in one ? Number(sparkplugLong(one)) : one))
}
const sparkplugLong = one => BigInt(one.high >>> 0) * 4294967296n + BigInt(one.low >>> 0)

function hear(topic, payload, { retain, qos }) {
  const message = { topic, payload: payload.toString('latin1'), hex: payload.toString('hex'), retain, qos }
  const place = waiting.findIndex(one => one.topic === topic)
  if (place < 0) heard.push(message)
  else waiting.splice(place, 1)[0].resolve(message)
}

const publish = (topic, payload, options = {}) => client.publishAsync(topic, payload, options).then(() => null)

const commands = {
  broker: async port => { // nobody may subscribe to fixed/…
    const { Aedes } = await import('aedes')
    const broker = await Aedes.createBroker()
    broker.authorizeSubscribe = (_, filter, done) => done(null, filter.topic.startsWith('fixed/') ? null : filter)
    await new Promise(resolve => net.createServer(broker.handle).listen(port, '127.0.0.1', resolve))
  },
  connect: async (port, options = {}) => {
    client = await mqtt.connectAsync(`mqtt://127.0.0.1:${port}`, { reconnectPeriod: 0, ...options })
    client.on('message', hear)
    client.on('error', () => {})
  },
  publish: (topic, payload, options) => publish(topic, payloadOf(payload), options),
  publish_sparkplug: (topic, payload) => publish(topic, Buffer.from(sparkplug.encodePayload(payload))),
  decode_sparkplug: hex => plain(sparkplug.decodePayload(Buffer.from(hex, 'hex'))),
  subscribe: filter => client.subscribeAsync(filter, { qos: 1 }).then(() => null),
  next: topic => {
    const place = heard.findIndex(one => one.topic === topic)
    if (place >= 0) return heard.splice(place, 1)[0]
    return new Promise(resolve => waiting.push({ topic, resolve }))
  },
  heard: () => heard.splice(0),
  count: (topic, size, ms) => {
    let number = 0
    const tell = () => publish(topic, JSON.stringify(Array(size).fill(++number)), { retain: true })
    setInterval(() => tell().catch(() => {}), ms)
    return tell()
  },
  repeat_sparkplug: (messages, ms) => {
    const tell = () => Promise.all(messages.map(one =>
      publish(one.topic, Buffer.from(sparkplug.encodePayload(one.payload)))))
    setInterval(() => tell().catch(() => {}), ms)
  },
  flood: async (topic, count) => {
    for (let number = 1; number < count; number++) client.publish(topic, String(number))
    await publish(topic, String(count), { qos: 1 })
  },
  die: () => { client.stream.destroy() }, // the broker publishes its last will
}

process.stdout.write('"ready"\n')
readline.createInterface({ input: process.stdin }).on('line', async line => {
  const [name, ...given] = JSON.parse(line)
  try {
    process.stdout.write(JSON.stringify((await commands[name](...given)) ?? null) + '\n')
  } catch (error) {
    process.stdout.write(JSON.stringify({ error: String(error) }) + '\n')
  }
}).on('close', () => process.exit(0))
