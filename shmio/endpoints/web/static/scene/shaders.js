// The programs that run in the graphics processor.

const HEAD = "#version 300 es\nprecision highp float;\n";

/** Lights a point as the sun, the sky and the ground do. */
const LIGHT = `
uniform vec3 eye;
uniform vec3 sun;
uniform mat4 toShadow;
uniform highp sampler2DShadow shadowMap;
uniform float shadowTexel;
uniform vec3 skyLight;
uniform vec3 groundLight;
uniform float sunLight;

float lit(vec3 world, vec3 normal) {
  vec3 at = (toShadow * vec4(world + 0.004 * normal, 1.0)).xyz * 0.5 + 0.5;
  if (any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return 1.0;
  float slope = 1.0 - max(dot(normal, sun), 0.0);
  at.z -= 0.0006 + 0.0016 * slope;
  float sum = texture(shadowMap, at);
  for (int step = 0; step < 8; step += 1) {
    float angle = 0.7854 * float(step);
    float radius = (step & 1) == 0 ? 1.1 : 2.2;
    sum += texture(shadowMap, at + vec3(radius * shadowTexel * vec2(cos(angle), sin(angle)), 0.0));
  }
  return sum / 9.0;
}

vec3 shaded(vec3 albedo, vec3 world, vec3 normal, float gloss) {
  vec3 view = normalize(eye - world);
  float front = max(dot(normal, sun), 0.0);
  float shadow = front > 0.0 ? lit(world, normal) : 0.0;
  float near = mix(0.55, 1.0, smoothstep(0.0, 0.7, world.z + 0.35 * normal.z));
  vec3 ambient = mix(groundLight, skyLight, 0.5 + 0.5 * normal.z) * near;
  float fill = 0.16 * max(dot(normal, normalize(vec3(-sun.xy, 0.35))), 0.0);
  float shine = pow(max(dot(normal, normalize(sun + view)), 0.0), 46.0) * shadow;
  float rim = pow(1.0 - max(dot(normal, view), 0.0), 4.0);
  return albedo * (ambient + sunLight * front * shadow + fill) + gloss * (0.35 * shine * sunLight + 0.10 * rim * skyLight);
}

vec3 screen(vec3 linear) {
  vec3 mapped = linear * (1.0 + linear / 7.0) / (1.0 + 0.45 * linear);
  return pow(clamp(mapped, 0.0, 1.0), vec3(1.0 / 2.2));
}
`;

export const BODY_VERTEX = `${HEAD}
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec4 color;
uniform mat4 model;
uniform mat4 toScreen;
out vec3 world;
out vec3 turned;
out vec3 albedo;
void main() {
  world = (model * vec4(position, 1.0)).xyz;
  turned = mat3(model) * normal;
  albedo = pow(color.rgb, vec3(2.2));
  gl_Position = toScreen * vec4(world, 1.0);
}`;

export const BODY_FRAGMENT = `${HEAD}${LIGHT}
in vec3 world;
in vec3 turned;
in vec3 albedo;
uniform int state; // as in STATES of renderer.js
uniform float highlight;
uniform vec3 injected;
uniform vec3 accent;
uniform float pixel;
out vec4 result;
void main() {
  vec3 normal = normalize(turned);
  vec3 color = albedo;
  if (state == 2) {
    float hatch = smoothstep(0.42, 0.52, abs(fract((gl_FragCoord.x + gl_FragCoord.y) / (11.0 * pixel)) - 0.5) * 2.0);
    color = mix(vec3(0.13), vec3(0.48), hatch);
  } else if (state == 1) color = mix(color, injected, 0.72);
  vec3 light = shaded(color, world, normal, state == 2 ? 0.1 : 1.0);
  float rim = pow(1.0 - max(dot(normal, normalize(eye - world)), 0.0), 2.0);
  if (state == 1) light += 0.55 * injected * (0.25 + rim);
  light += highlight * accent * (0.22 + 0.9 * rim);
  result = vec4(screen(light), 1.0);
}`;

export const FLOOR_VERTEX = `${HEAD}
uniform vec4 extent;
uniform mat4 toScreen;
out vec3 world;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  world = vec3(extent.xy + corner * extent.zw, 0.0);
  gl_Position = toScreen * vec4(world, 1.0);
}`;

export const FLOOR_FRAGMENT = `${HEAD}${LIGHT}
in vec3 world;
uniform vec4 extent;
uniform float grid;
uniform vec3 floorColor;
uniform vec3 lineColor;
out vec4 result;

float lines(vec2 at, float width) {
  vec2 size = fwidth(at);
  vec2 away = abs(fract(at - 0.5) - 0.5) / max(size, vec2(1e-6));
  vec2 found = (1.0 - smoothstep(0.0, width, away)) * (1.0 - smoothstep(0.15, 0.5, size));
  return max(found.x, found.y);
}

void main() {
  vec3 color = floorColor;
  if (grid > 0.0) {
    color = mix(color, lineColor, 0.28 * lines(world.xy / (0.2 * grid), 1.0));
    color = mix(color, lineColor, 0.85 * lines(world.xy / grid, 1.3));
  }
  float shadow = lit(world, vec3(0.0, 0.0, 1.0));
  vec2 edge = abs(world.xy - extent.xy) / extent.zw;
  float far = 1.0 - smoothstep(0.72, 1.0, max(edge.x, edge.y));
  float below = eye.z < 0.0 ? 0.25 : 1.0;
  result = vec4(color * mix(0.5, 1.0, shadow), far * below);
}`;

export const SHADOW_VERTEX = `${HEAD}
layout(location = 0) in vec3 position;
uniform mat4 model;
uniform mat4 toScreen;
void main() {
  gl_Position = toScreen * model * vec4(position, 1.0);
}`;

export const SHADOW_FRAGMENT = `${HEAD}
void main() {}`;

export const SKY_VERTEX = `${HEAD}
out float height;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0;
  height = corner.y * 0.5 + 0.5;
  gl_Position = vec4(corner, 0.9999, 1.0);
}`;

export const SKY_FRAGMENT = `${HEAD}
in float height;
uniform vec3 low;
uniform vec3 high;
out vec4 result;
void main() {
  result = vec4(mix(low, high, smoothstep(0.35, 1.0, height)), 1.0);
}`;
