// One sample of a cloud: dequantised relative to the eye, projected, lit, and given its shape (see splats.py).
//
// COMMANDS: the vertex is an attribute, and the cloud's parameters are per-instance attributes, chosen by the base
// instance of an indirect command. Without it both are texels, found by the number of the vertex (OpenGL 3.3 to 4.2).
// BLENDED: its shape is that of a kernel (see blend_kernels.gather).

// vertex: x, y, z in steps; two octahedral bytes
// color: 0 to 1; the last of them says how far apart samples are in a thin part of the cloud (thin.py)
// cloud_origin: offset of the cloud's (0, 0, 0) from the eye, axes of model space; model units of a step
// cloud_corner: offset of the same from the corner of the node's cell; side of a splat, pixels times depth,
//     or where the level says to look it up, model units of a step times what places.py says of the node's own samples
// cloud_numbers: node; its row among the places, + STARVED; its level, or -1: one spacing everywhere; samples
#ifdef COMMANDS
in vec4 vertex;
in vec4 color;
in vec4 cloud_origin;
in vec4 cloud_corner;
in ivec4 cloud_numbers;
#else
uniform usampler2D vertices;
uniform sampler2D colors;
uniform isampler2D clouds;  // of each cloud these three, and where in the other two its first sample is
uniform int samples;        // vertices of a cloud
uniform int wide;           // samples in a row of texels
vec4 vertex, color, cloud_origin, cloud_corner;
ivec4 cloud_numbers;
#endif

uniform mat3 rotation;     // model space to camera space: right, up, depth
uniform vec2 size;         // of the picture, pixels
uniform float margin;      // of the viewport around the picture, pixels
uniform float focal;
uniform vec2 range;        // nearest and farthest depth
uniform float largest;
uniform float round_from;
uniform float round_factor;
uniform float steepest;
uniform float reach;
uniform float closing;     // side of a splat over the spacing to close, times the focal length
uniform sampler2D places;  // of each level (axis, half); then of each node (links, spacings); spreads: see places.py
uniform int levels;
uniform int spreads;       // where these begin, texels
uniform bool oriented;
uniform vec3 albedo;
uniform vec3 lamp;         // camera space
uniform bool lit;
uniform bool two_sided;

flat out vec3 center;      // camera space
flat out vec2 middle;      // the same on the picture, pixels, y up
flat out vec3 plane;       // normal of a disc's plane
#ifdef BLENDED
flat out vec3 linear;
flat out vec3 form;
flat out float share;
flat out float farthest;
#else
flat out vec3 rgb;
flat out float extent;     // half a side, pixels; of a disc its radius, model units
flat out float side;
flat out int kind;
flat out int seen;
#endif

const float AMBIENT = @AMBIENT@;
const float DIFFUSE = @DIFFUSE@;
const float SPECULAR = @SPECULAR@;
const float SHININESS = @SHININESS@;
const float UNLIT = @UNLIT@;

const int STARVED = 1 << 30;
const float PIXEL2 = @PIXEL@ * @PIXEL@;

vec4 texel(int i) {
    return texelFetch(places, ivec2(i & 1023, i >> 10), 0);
}

// The same rule as rules.facing.
float facing(int row, int level, vec3 p) {
    float spacing = 0.0;
    while (row >= 0) {
        vec2 halving = texel(level).xy;
        vec3 axis = vec3(equal(vec3(halving.x), vec3(0.0, 1.0, 2.0)));
        vec4 node = texel(levels + row);
        bool above = dot(p, axis) >= halving.y;
        p -= above ? axis * halving.y : vec3(0.0);
        row = int(above ? node.y : node.x);
        spacing = above ? node.w : node.z;
        ++level;
    }
    return abs(spacing);
}

// The same rule as rules.spacing_at: the spacing to close at p, negative where starved.
float spacing_at(int row, int level, float full, vec3 p) {
    float coarsest = 0.0;
    float spacing = 0.0;
    int last = row;
    while (row >= 0) {
        vec2 halving = texel(level).xy;
        vec3 axis = vec3(equal(vec3(halving.x), vec3(0.0, 1.0, 2.0)));
        vec4 node = texel(levels + row);
        bool above = dot(p, axis) >= halving.y;
        int beyond = int(above ? node.x : node.y);
        float other = abs(above ? node.z : node.w);
        float apart = abs(dot(p, axis) - halving.y);
        last = row;
        row = int(above ? node.y : node.x);
        spacing = above ? node.w : node.z;
        ++level;
        if (other > max(coarsest, row < 0 ? abs(spacing) : 0.0) && apart < reach * other) {
            float edge = above ? halving.y * (1.0 - 1e-6) : 0.0;
            if (beyond >= 0)
                other = facing(beyond, level, p * (1.0 - axis) + edge * axis);
            if (apart < reach * other)
                coarsest = max(coarsest, other);
        }
        p -= above ? axis * halving.y : vec3(0.0);
    }
    coarsest = full > 0.0 ? max(coarsest, full * texel(spreads + last / 4)[last % 4]) : coarsest;
    return spacing < 0.0 ? -max(-spacing, coarsest) : max(spacing, coarsest);
}

vec3 octahedral(float code) {
    float high = floor(code / 256.0);
    vec2 uv = vec2(code - high * 256.0, high) / 127.0 - 1.0;
    float w = 1.0 - abs(uv.x) - abs(uv.y);
    if (w < 0.0)
        uv = (1.0 - abs(uv.yx)) * vec2(uv.x >= 0.0 ? 1.0 : -1.0, uv.y >= 0.0 ? 1.0 : -1.0);
    return vec3(uv, w);
}

// Factor of the albedo and highlight: see shading.py.
vec2 light(vec3 n) {
    vec3 v = -normalize(center);
    if (two_sided && dot(n, v) < 0.0)
        n = -n;
    float toward = dot(n, lamp);
    if (toward <= 0.0)
        return vec2(AMBIENT, 0.0);
    float mirror = 2.0 * toward * dot(n, v) - dot(lamp, v);
    return vec2(AMBIENT + DIFFUSE * toward, mirror <= 0.0 ? 0.0 : SPECULAR * pow(mirror, SHININESS));
}

// Toward the eye, and seen no more from the side than `steepest`.
vec3 disc_plane(vec3 n) {
    vec3 away = normalize(center);
    float facing = -dot(n, away);
    if (facing < 0.0) {
        n = -n;
        facing = -facing;
    }
    return normalize(n - max(steepest - facing, 0.0) * away);
}

#ifdef BLENDED
// The kernel of a sample whose splat has such a side.
void shape_kernel(float side) {
    vec2 slope = center.xy / center.z;
    float spread = @KERNEL@ * side;
    vec2 lean = plane.xy - slope * plane.z;
    vec2 own = max(1.0 + slope * slope - lean * lean, 0.0);
    float along = dot(plane, vec3(slope, 1.0));
    float spread2 = spread * spread;
    float det = spread2 * along * spread2 * along + PIXEL2 * (spread2 * (own.x + own.y) + PIXEL2);
    own = spread2 * own + PIXEL2;
    form = vec3(own.yx, spread2 * (lean.x * lean.y - slope.x * slope.y)) / det;
    float radius = @KERNEL_ENDS@ * spread / focal;
    vec2 half_size = @KERNEL_ENDS@ / (1.0 - min(radius, 0.5)) * sqrt(own);
    gl_PointSize = ceil(2.0 * max(half_size.x, half_size.y)) + 1.0;
    share = spread2 * abs(along) / sqrt(det);
    farthest = center.z * @BEHIND@ * max(radius, 1.0 / focal) / max(abs(along), @SLANTED@);
}
#endif

void drop() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 1.0;
}

#ifndef COMMANDS
ivec4 told(int i) {
    return texelFetch(clouds, ivec2(i & 1023, i >> 10), 0);
}

// Find the sample of this vertex; return false where its cloud has none.
bool fetch() {
    int cloud = gl_VertexID / samples;
    int number = gl_VertexID - cloud * samples;
    cloud_numbers = told(4 * cloud + 2);
    if (number >= cloud_numbers.w)
        return false;
    cloud_origin = intBitsToFloat(told(4 * cloud));
    cloud_corner = intBitsToFloat(told(4 * cloud + 1));
    ivec2 at = told(4 * cloud + 3).xy + ivec2(number % wide, number / wide);
    vertex = vec4(texelFetch(vertices, at, 0));
    color = texelFetch(colors, at, 0);
    return true;
}
#endif

void main() {
#ifndef COMMANDS
    if (!fetch()) {
        drop();
        return;
    }
#endif
    vec3 q = cloud_origin.xyz + cloud_origin.w * vertex.xyz;
    center = rotation * q;
    float depth = center.z;
    if (!(depth > range.x)) {
        drop();
        return;
    }
    bool has_normal = vertex.w > 0.0;
    vec3 normal = octahedral(vertex.w);
    if (lit && has_normal && !two_sided && dot(normal, q) > 0.0) {
        drop();
        return;
    }
    normal = normalize(rotation * normal);
    vec2 shade = lit ? (has_normal ? light(normal) : vec2(UNLIT, 0.0)) : vec2(1.0, 0.0);
    vec3 lit_color = min(color.rgb * albedo * shade.x + shade.y, 1.0);
    middle = 0.5 * size + center.xy * (focal / depth);
    float across = cloud_corner.w;
    bool starved = cloud_numbers.y >= STARVED;
    if (cloud_numbers.z >= 0) {
        float thin = floor(255.0 * color.a + 0.5);
        float full = thin > 0.0 ? cloud_corner.w * exp2(thin / @STEPS@) : 0.0;
        vec3 inside = cloud_corner.xyz + cloud_origin.w * vertex.xyz;
        float spacing = spacing_at(cloud_numbers.y & (STARVED - 1), cloud_numbers.z, full, inside);
        across = abs(spacing) * closing;
        starved = spacing < 0.0;
    }
    gl_Position = vec4(2.0 * (middle + margin) / (size + 2.0 * margin) - 1.0, 0.0, 1.0);
#ifdef BLENDED
    vec3 level = floor(255.0 * lit_color + 0.5) / 255.0;
    linear = mix(pow((level + 0.055) / 1.055, vec3(2.4)), level / 12.92, lessThanEqual(level, vec3(0.04045)));
    plane = oriented && has_normal ? disc_plane(normal) : vec3(0.0, 0.0, -1.0);
    shape_kernel(min(across / depth, largest));
#else
    rgb = lit_color;
    seen = cloud_numbers.x;
    side = min(across / depth, largest);
    extent = 0.5 * side * (side > round_from ? round_factor : 1.0);
    gl_PointSize = ceil(2.0 * extent) + 1.0;
    plane = vec3(0.0);
    if (side <= 1.0) {
        kind = POINT;
        gl_PointSize = 1.0;
    } else if (side <= round_from) {
        kind = SQUARE;
    } else if (oriented && has_normal) {
        kind = DISC;
        plane = disc_plane(normal);
        vec2 slope = center.xy / depth;
        vec2 lean = plane.xy - slope * plane.z;
        vec2 half_size = extent * sqrt(max(1.0 + slope * slope - lean * lean, 0.0));
        extent *= depth / focal;
        half_size /= 1.0 - min(extent / depth, 0.5);
        gl_PointSize = ceil(2.0 * max(half_size.x, half_size.y)) + 1.0;
    } else {
        kind = BALL;
    }
    if (starved)
        side = -max(side, 1e-6);
#endif
}
