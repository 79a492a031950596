// A rosbridge v2 server without ROS, written from ROSBRIDGE_PROTOCOL.md with the package ws.
//
// Usage: node rosbridge_server.js PORT; it takes commands on standard input, a JSON list a line, and answers each.
// Every topic is latched: a new subscriber gets the last message. As rosbridge does, it sends uint8[] as base64.
'use strict'

const readline = require('readline')
const { WebSocketServer } = require('ws')

const topics = new Map() // name -> {type, last, refused}
const clients = new Map() // socket -> {subscribed: Set, advertised: Map}

// Whole numbers of 16 and more digits become texts and back, since JavaScript's numbers would round them.
const parse = text => JSON.parse(text.replace(/(?<=[[:,]\s*)-?\d{16,}(?=\s*[,\]}])/g, '"#$&"'))
const format = value => JSON.stringify(value).replace(/"#(-?\d+)"/g, '$1')

function topicOf(name) {
  if (!topics.has(name)) topics.set(name, { type: null, last: null, refused: '' })
  return topics.get(name)
}

function deliver(name, msg) {
  if (topicOf(name).type === 'std_msgs/UInt8MultiArray' && Array.isArray(msg.data)) {
    msg = { ...msg, data: Buffer.from(msg.data).toString('base64') }
  }
  topicOf(name).last = msg
  topicOf(name).history = [...(topicOf(name).history ?? []), msg].slice(-10)
  for (const [socket, client] of clients) {
    if (client.subscribed.has(name)) socket.send(format({ op: 'publish', topic: name, msg }))
  }
}

function status(socket, id, text) {
  socket.send(JSON.stringify({ op: 'status', id, level: 'error', msg: text }))
}

// The services of rosapi, from the definitions of rosapi_msgs.
const rosapi = {
  '/rosapi/topics': () => {
    const names = [...topics.keys()].filter(name => topics.get(name).type !== null)
    return { topics: names, types: names.map(name => topics.get(name).type.replace('/', '/msg/')) }
  },
  '/rosapi/topic_type': ({ topic }) => ({ type: topics.get(topic)?.type ?? '' }),
  '/rosapi/publishers': ({ topic }) => ({ publishers: topics.get(topic)?.last ? ['/robot'] : [] }),
}
let services = true

function handle(socket, client, { op, id, topic, type, msg, service, args }) {
  if (op === 'call_service') {
    const known = services && service in rosapi
    const values = known ? rosapi[service](args) : `Service ${service} does not exist`
    return socket.send(JSON.stringify({ op: 'service_response', id, service, values, result: known }))
  }
  const found = topicOf(topic)
  if (op === 'subscribe' || op === 'advertise') {
    const plain = type.replace('/msg/', '/')
    if (found.type !== null && found.type !== plain) return status(socket, id, `${topic} is a ${found.type}`)
    found.type = plain
    if (op === 'advertise') client.advertised.add(topic)
    else {
      client.subscribed.add(topic)
      if (found.last !== null) socket.send(format({ op: 'publish', topic, msg: found.last }))
    }
  } else if (op === 'unsubscribe') client.subscribed.delete(topic)
  else if (op === 'unadvertise') client.advertised.delete(topic)
  else if (op === 'publish') {
    if (!client.advertised.has(topic)) return status(socket, id, `${topic} was not advertised`)
    if (found.refused) return status(socket, id, found.refused)
    if (msg.header && !msg.header.stamp) msg.header.stamp = { sec: 1700000000, nanosec: 5 }
    deliver(topic, msg)
  } else status(socket, id, `unknown op ${op}`)
}

const commands = {
  declare: (topic, type) => { topicOf(topic).type = type },
  services: on => { services = on },
  publish: (topic, msg) => deliver(topic, msg),
  raw: text => { for (const socket of clients.keys()) socket.send(text) },
  binary: hex => { for (const socket of clients.keys()) socket.send(Buffer.from(hex, 'hex')) },
  refuse: (topic, text) => { topicOf(topic).refused = text },
  last: topic => topicOf(topic).last,
  history: topic => topicOf(topic).history,
  forget: topic => { topics.delete(topic) },
  clients: () => clients.size,
  subscribed: () => [...clients.values()].flatMap(client => [...client.subscribed]),
  advertised: () => [...clients.values()].flatMap(client => [...client.advertised]),
  count: (topic, size, ms) => {
    let number = 0
    setInterval(() => deliver(topic, { layout: { dim: [], data_offset: 0 }, data: Array(size).fill(++number) }), ms)
  },
}

const server = new WebSocketServer({ host: '127.0.0.1', port: Number(process.argv[2]) })
server.on('connection', socket => {
  const client = { subscribed: new Set(), advertised: new Set() }
  clients.set(socket, client)
  socket.on('message', data => handle(socket, client, parse(data.toString())))
  socket.on('close', () => clients.delete(socket))
  socket.on('error', () => clients.delete(socket))
})
server.on('listening', () => {
  process.stdout.write('"ready"\n')
  readline.createInterface({ input: process.stdin }).on('line', line => {
    const [name, ...given] = parse(line)
    const answer = commands[name](...given)
    process.stdout.write(format(answer === undefined ? null : answer) + '\n')
  }).on('close', () => process.exit(0))
})
