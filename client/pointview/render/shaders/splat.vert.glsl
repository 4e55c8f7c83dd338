// One sample of a cloud: dequantised relative to the eye, projected, lit.
//
// COMMANDS: the cloud's parameters arrive as per-instance attributes, chosen by the base instance of an indirect
// command. Without it they are uniforms, and every cloud is a draw of its own (OpenGL 3.3 to 4.2).

in vec4 vertex;      // x, y, z in steps; two octahedral bytes
in vec4 color;       // 0 to 1

#ifdef COMMANDS
in vec3 offset;      // of the cloud's (0, 0, 0) from the eye, axes of model space
in vec2 placement;   // model units of a step; side of a splat, pixels times depth
in int node;
#else
uniform vec3 offset;
uniform vec2 placement;
uniform int node;
#endif

uniform mat3 rotation;     // model space to camera space: right, up, depth
uniform vec2 size;         // of the picture, pixels
uniform float margin;      // of the viewport around the picture, pixels
uniform float focal;
uniform vec2 range;        // nearest and farthest depth
uniform float largest;     // side of a splat, pixels
uniform float round_from;
uniform float round_factor;
uniform vec3 albedo;
uniform vec3 lamp;
uniform bool lit;
uniform bool two_sided;

flat out vec3 rgb;
flat out vec2 middle;      // of the splat, window coordinates, y up
flat out vec2 reach;       // half a side; 1 if round
flat out float depth;
flat out int seen;

const float AMBIENT = @AMBIENT@;
const float DIFFUSE = @DIFFUSE@;
const float SPECULAR = @SPECULAR@;
const float SHININESS = @SHININESS@;
const float UNLIT = @UNLIT@;

vec3 octahedral(float code) {
    float high = floor(code / 256.0);
    vec2 uv = vec2(code - high * 256.0, high) / 127.0 - 1.0;
    float w = 1.0 - abs(uv.x) - abs(uv.y);
    if (w < 0.0)
        uv = (1.0 - abs(uv.yx)) * vec2(uv.x >= 0.0 ? 1.0 : -1.0, uv.y >= 0.0 ? 1.0 : -1.0);
    return vec3(uv, w);
}

// Factor of the albedo and highlight: see shading.py. `p` is the sample in camera space.
vec2 light(vec3 normal, vec3 p) {
    vec3 n = normalize(rotation * normal);
    vec3 v = -normalize(p);
    if (two_sided && dot(n, v) < 0.0)
        n = -n;
    float toward = dot(n, lamp);
    if (toward <= 0.0)
        return vec2(AMBIENT, 0.0);
    float mirror = 2.0 * toward * dot(n, v) - dot(lamp, v);
    return vec2(AMBIENT + DIFFUSE * toward, mirror <= 0.0 ? 0.0 : SPECULAR * pow(mirror, SHININESS));
}

void drop() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 1.0;
}

void main() {
    vec3 q = offset + placement.x * vertex.xyz;
    vec3 p = rotation * q;
    depth = p.z;
    if (!(depth > range.x)) {
        drop();
        return;
    }
    vec2 shade = vec2(1.0, 0.0);
    if (lit) {
        shade = vec2(UNLIT, 0.0);
        if (vertex.w > 0.0) {
            vec3 normal = octahedral(vertex.w);
            if (!two_sided && dot(normal, q) > 0.0) {
                drop();
                return;
            }
            shade = light(normal, p);
        }
    }
    rgb = min(color.rgb * albedo * shade.x + shade.y, 1.0);
    seen = node;
    middle = 0.5 * size + p.xy * (focal / depth);
    float side = min(placement.y / depth, largest);
    bool is_round = side > round_from;
    reach = vec2(0.5 * side * (is_round ? round_factor : 1.0), is_round ? 1.0 : 0.0);
    if (side <= 1.0) {
        reach.x = 0.0;
        gl_PointSize = 1.0;
    } else {
        gl_PointSize = ceil(2.0 * reach.x) + 1.0;
    }
    // A point is drawn without interpolation, so any increasing function of the depth will do: the logarithm keeps the
    // same relative precision everywhere.
    float z = log(depth / range.x) / log(range.y / range.x);
    gl_Position = vec4(2.0 * (middle + margin) / (size + 2.0 * margin) - 1.0, 2.0 * z - 1.0, 1.0);
}
